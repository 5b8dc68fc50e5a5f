"""What rewax uses of MJX without a public name is in one file, and MJX has it."""

import re
from pathlib import Path

import mujoco
import rigid_models
from mujoco import mjx
from rigid_cases import VERSIONS, loaded

from rewax.physics import rigid
from rewax.physics.rigid import mjx_access

ROOT = Path(rigid.__file__).parents[2]
FUNCTIONS = (
    "collision", "make_constraint", "passive", "transmission", "fwd_actuation", "tendon", "put_model", "make_data",
)  # fmt: skip
OF_THE_MODEL = (
    *rigid.PARAMETERS, "opt", "site_pos", "site_quat", "eq_data", "npair", "pair_geom1", "pair_geom2", "pair_dim",
    "pair_solreffriction", "geom_contype", "geom_conaffinity", "geom_rbound", "numeric_data",
    "actuator_forcelimited", "actuator_dyntype", "tendon_actfrclimited", "tendon_actfrcrange", "jnt_actfrclimited", "jnt_actfrcrange",
)  # fmt: skip
READ_AND_WRITTEN = (
    "qpos", "qvel", "act", "ctrl", "xpos", "xmat", "xipos", "ximat", "subtree_com", "cdof", "cvel", "geom_xpos", "geom_xmat",
    "site_xpos", "site_xmat", "qfrc_passive", "qfrc_actuator", "qfrc_gravcomp", "act_dot", "actuator_length",
    "actuator_force", "eq_active",
)  # fmt: skip
OF_THE_IMPLEMENTATION = (
    "ne", "nf", "ncon", "contact", "actuator_moment", "actuator_velocity", "ten_J", "ten_velocity", "efc_J", "efc_D",
    "efc_aref", "efc_frictionloss",
)  # fmt: skip
OF_A_CONTACT = (
    "dist", "pos", "frame", "includemargin", "friction", "solref", "solreffriction", "solimp", "dim", "geom", "geom1",
    "geom2", "efc_address",
)  # fmt: skip


def test_mjx_has_what_is_used_of_it():
    _, model = loaded("contraption")
    data = model.static.data
    missing = [f"mjx.{name}" for name in FUNCTIONS if not callable(getattr(mjx, name, None))]
    for what, holder, fields in (
        ("mjx.Model", model.static.mjx, OF_THE_MODEL),
        ("mjx.Data", data, READ_AND_WRITTEN),
        ("mjx.Data._impl", data._impl, OF_THE_IMPLEMENTATION),
        ("mjx.Contact", data._impl.contact, OF_A_CONTACT),
    ):
        missing += [f"{what}.{name}" for name in fields if not hasattr(holder, name)]
    assert not missing, f"{VERSIONS} {', '.join(missing)} are gone"


def test_no_other_file_names_what_is_private_in_mjx():
    private = re.compile(r"\b_impl\b|mjx\._src|mujoco\.\w+\._")
    found = {
        path.name for path in ROOT.rglob("*.py") if private.search(path.read_text()) and "lowering" not in path.parts
    }
    assert found == {"mjx_access.py"}
    source = Path(mjx_access.__file__).read_text()
    uses = [line for line in source.splitlines() if re.search(r"[d)]\._impl|\"_impl", line)]
    assert "_src" not in source and len(uses) > 8
    assert not [line for line in uses if "  # " not in line], "say why"


def test_rows_are_counted_in_their_order():
    """Equalities, then dry friction: as MuJoCo counts them in C."""
    mj, model = loaded("contraption")
    data = mujoco.MjData(mj)
    mujoco.mj_forward(mj, data)
    assert mjx_access.num_bounded_rows(model.static.data) == (data.ne, data.nf) and data.ne and data.nf
    text = rigid_models.mjcf('<body><freejoint name="f"/><geom size=".1"/></body>')
    assert mjx_access.num_bounded_rows(rigid.load(text).static.data) == (0, 0)
