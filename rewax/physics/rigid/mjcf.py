"""Compiles MJCF models and refuses those with unsupported features."""

# pyright: reportAttributeAccessIssue=false

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from rewax.physics.numerics.arguments import check_instance

LIMITS = ("max_contact_points", "max_geom_pairs")
"""Custom numerics of a model that limit the number of MJX's contacts."""
_REMEDY = "give a path, MJCF text, an MjSpec or an MjModel"
_LONGEST_NAME = 200
_ATTRIBUTE = re.compile(r"""([\w:]+)\s*=\s*["']([^"']*)["']""")
_TEXTS = frozenset(["name", "class", "childclass", "file", "model"])
"""Attributes of MJCF that may hold the word nan."""


def compile_model(source: Any) -> mujoco.MjModel:
    """MuJoCo's model of an MJCF file, MJCF text or a ``mujoco.MjSpec``. A ``mujoco.MjModel`` is returned unchanged.

    Raises:
      ValueError: the source is none of these, or MuJoCo cannot read it.
    """
    if isinstance(source, mujoco.MjModel):
        return source
    if not isinstance(source, (mujoco.MjSpec, str, Path)):
        raise ValueError(f"a {type(source).__name__} is not a model: {_REMEDY}")
    source = source.lstrip("\ufeff \t\r\n") if isinstance(source, str) else source
    is_text = isinstance(source, str) and source.startswith("<")
    if not is_text and not isinstance(source, mujoco.MjSpec):
        if not _is_file(Path(source)):
            raise ValueError(f"there is no MJCF file {str(source)[:_LONGEST_NAME]!r}: {_REMEDY}")
        _refuse_nan(Path(source).read_text(encoding="utf-8", errors="replace"))
    elif is_text:
        _refuse_nan(source)
    try:
        if isinstance(source, mujoco.MjSpec):
            return source.compile()
        return mujoco.MjModel.from_xml_string(source) if is_text else mujoco.MjModel.from_xml_path(str(source))
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"the model cannot be read: {_sentence(error)}: correct the MJCF") from error


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False


def _refuse_nan(text: str) -> None:
    """Raises ValueError for attributes with NaN: MuJoCo takes some of them for absent and keeps others."""
    if "nan" not in text.lower():
        return
    text = re.sub(r"<!--.*?-->", lambda comment: "\n" * comment[0].count("\n"), text, flags=re.DOTALL)
    for found in _ATTRIBUTE.finditer(text):
        if found[1] not in _TEXTS and {"nan", "-nan", "+nan"} & {*found[2].lower().split()}:
            line = text.count("\n", 0, found.start()) + 1
            raise ValueError(f"{found[1]} is {found[2]!r} in line {line} of the MJCF: give finite numbers")


def _sentence(error: Exception) -> str:
    """MuJoCo's message in one line, without empty names."""
    lines = [" ".join(line.split()) for line in str(error).splitlines() if line.strip()]
    first = re.sub(r"^(XML )?Error: (Error: )?", "", lines[0] if lines else "MuJoCo gives no reason").rstrip(":")
    rest = ", ".join(lines[1:]).replace("Element name '', ", "element ").replace("Element", "element")
    return f"{first} ({rest})" if rest else first


def is_disabled(mj: mujoco.MjModel, name: str) -> bool:
    """Whether the model sets MuJoCo's disable flag ``mjDSBL_<name>``."""
    return bool(mj.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))


def numeric(mj: mujoco.MjModel, name: str) -> list[int]:
    """Index at which MJX reads a custom numeric of this name: its id, not its address. Empty if there is none."""
    found = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    return [found] if found >= 0 else []


def limit(mj: mujoco.MjModel, name: str) -> int | None:
    """The value of one of ``LIMITS``; None: the model sets no limit."""
    found = [int(value) for value in mj.numeric_data[numeric(mj, name)]]
    return found[0] if found and found[0] >= 0 else None


def own_pairs(mj: mujoco.MjModel, first: str, second: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ids of explicit pairs of two kinds of geoms, and the ids of their two geoms, shape (n,) each.

    Empty if contacts are disabled or limited. Pairs whose masks also permit a contact are left out: without the
    explicit pair, MJX would collide them.

    Args:
      mj: the model.
      first, second: kinds of geoms, "sphere", "capsule" or "box".
    """
    limited = any(limit(mj, name) is not None for name in LIMITS)
    geoms = np.stack([mj.pair_geom1, mj.pair_geom2], axis=1)
    kinds = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")) for kind in (first, second)]
    ordered = (mj.geom_type[geoms] == kinds).all(axis=1)
    chosen = ordered | (mj.geom_type[geoms] == kinds[::-1]).all(axis=1)
    by_type, by_affinity = mj.geom_contype[geoms], mj.geom_conaffinity[geoms]
    chosen &= np.all(by_type & by_affinity[:, ::-1] == 0, axis=1)
    pairs = np.flatnonzero(chosen & (not limited and not is_disabled(mj, "CONTACT")))
    geoms = np.where(ordered[:, None], geoms, geoms[:, ::-1])[pairs]
    return pairs, geoms[:, 0], geoms[:, 1]


def lone_dofs(mj: mujoco.MjModel) -> np.ndarray:
    """Degrees of freedom of free joints whose tree has no other joint, shape (n, 6)."""
    start = mj.jnt_dofadr[mj.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    root = mj.body_rootid[mj.dof_bodyid]
    alone = np.array([np.sum(root == root[dof]) == 6 for dof in start], bool)
    return start[alone][:, None] + np.arange(6)


def number(mj: mujoco.MjModel, kind: str, name: str) -> int:
    """Id of a body, geom or joint with this name.

    Raises:
      ValueError: there is none. The message lists the known names.
    """
    check_instance(f"the name of a {kind}", name, str, "give a string")
    found = mujoco.mj_name2id(mj, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if found < 0:
        count = {"body": mj.nbody, "geom": mj.ngeom, "joint": mj.njnt}[kind]
        known = [mujoco.mj_id2name(mj, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), i) for i in range(count)]
        raise ValueError(f"the model has no {kind} {name!r}: known are {', '.join(n for n in known if n)}")
    return found


def check_model(mj: mujoco.MjModel, *, penalty: bool) -> None:
    """Raises a ValueError if the model has a feature that rewax would compute wrongly or ignore.

    Args:
      mj: the model.
      penalty: whether contacts and limits follow a penalty law instead of MuJoCo's constraints.
    """
    _check_options(mj, penalty)
    _check_actuators(mj)
    _check_fields(mj)
    _check_constraints(mj, penalty)


def _check_options(mj: mujoco.MjModel, penalty: bool) -> None:
    euler, fast = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if mj.opt.integrator not in (euler, fast):
        name = mujoco.mjtIntegrator(mj.opt.integrator).name.removeprefix("mjINT_")
        raise ValueError(
            f'the model\'s integrator is {name}, which is not supported: load(..., integrator="Euler"), or '
            '"implicitfast"'
        )
    if mj.opt.integrator == fast and (mj.opt.density or mj.opt.viscosity):
        raise ValueError(
            "the model's integrator is IMPLICITFAST in a medium with drag, which is not supported: load(..., "
            'integrator="Euler"), or density=0.0, viscosity=0.0'
        )
    if not penalty and mj.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        raise ValueError(
            "the model's friction cone is elliptic, for which gradients are not finite: load(..., "
            'cone="pyramidal"), or with a Penalty'
        )
    if mj.nflex or mj.nplugin:
        raise ValueError("the model has flexes or plugins, which are not supported: remove them")
    if not mj.nv:
        raise ValueError("no body of the model has a joint, so nothing can move: give one a joint")
    for flag, what in (("SPRING", "stiffness"), ("DAMPER", "damping")):
        if is_disabled(mj, flag):
            raise ValueError(
                f"the model disables its {flag.lower()}s, which is not supported: remove the flag and set {what} to "
                "zero"
            )
    if mj.opt.noslip_iterations:
        raise ValueError("the model has noslip_iterations, which are not supported: load(..., noslip_iterations=0)")
    if mj.opt.enableflags & getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0):
        raise ValueError('the model lets bodies sleep, which is not supported: load(..., flags={"sleep": False})')
    for flag in ("OVERRIDE", "DIAGEXACT", "SPECULATIVE"):
        if mj.opt.enableflags & int(getattr(mujoco.mjtEnableBit, f"mjENBL_{flag}", 0)):
            name = flag.lower()
            raise ValueError(
                f'the model enables the flag {name}, which is not supported: load(..., flags={{"{name}": False}})'
            )
    if mj.opt.disableactuator:
        raise ValueError("the model has an actuatorgroupdisable, which is not supported: remove it, or the actuators")


def _check_actuators(mj: mujoco.MjModel) -> None:
    for field, prefix, kinds in (
        ("actuator_trntype", "mjTRN", ("JOINT", "JOINTINPARENT", "SITE", "TENDON")),
        ("actuator_dyntype", "mjDYN", ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT", "MUSCLE")),
        ("actuator_gaintype", "mjGAIN", ("FIXED", "AFFINE", "MUSCLE")),
        ("actuator_biastype", "mjBIAS", ("NONE", "AFFINE", "MUSCLE")),
    ):
        enum = getattr(mujoco, f"mjt{prefix.removeprefix('mj').capitalize()}")
        wrong = ~np.isin(getattr(mj, field), [int(getattr(enum, f"{prefix}_{kind}")) for kind in kinds])
        if np.any(wrong):
            actuator, what = named(mj, "actuator", wrong), field.removeprefix("actuator_")
            raise ValueError(
                f"{actuator} has a {what} that is not supported: use one of {', '.join(k.lower() for k in kinds)}"
            )

    check_gear(mj, mj.actuator_gear)


def check_gear(mj: mujoco.MjModel, gear: np.ndarray) -> None:
    """Raises ValueError for an actuator that turns a site against its refsite; gear has shape (num_actuators, 6)."""
    turning = (mj.actuator_trnid[:, 1] >= 0) & np.any(gear[:, 3:] != 0, axis=1)
    turning &= mj.actuator_trntype == int(mujoco.mjtTrn.mjTRN_SITE)
    if np.any(turning):
        raise ValueError(
            f"{named(mj, 'actuator', turning)} turns a site against its refsite, which is not supported: set the last "
            "three numbers of its gear to zero, or remove the refsite"
        )


_UNSUPPORTED = (
    ("actuator_actearly", "actearly"),
    ("actuator_delay", "a delay"),
    ("actuator_armature", "an armature"),
    ("actuator_damping", "a damping"),
    ("actuator_dampingpoly", "a nonlinear damping"),
    ("jnt_stiffnesspoly", "a nonlinear stiffness"),
    ("dof_dampingpoly", "a nonlinear damping"),
    ("jnt_springyield", "a springyield"),
    ("tendon_stiffnesspoly", "a nonlinear stiffness"),
    ("tendon_dampingpoly", "a nonlinear damping"),
    ("tendon_springyield", "a springyield"),
    ("tendon_armature", "an armature"),
    ("geom_adhesion", "an adhesion"),
    ("pair_adhesion", "an adhesion"),
    ("geom_surfacevel", "a surfacevel"),
    ("geom_fluid", "a fluidshape"),
)
"""Fields of MuJoCo's model that must be zero because MJX ignores them. Older versions lack some of them."""


def _check_fields(mj: mujoco.MjModel) -> None:
    for field, what in _UNSUPPORTED:
        value = np.asarray(getattr(mj, field, np.zeros((0, 1))))
        wrong = np.any(value.reshape(len(value), -1) != 0, axis=1) if value.size else np.zeros(0, bool)
        if np.any(wrong):
            kind = field.split("_")[0]
            if kind == "dof":
                wrong = np.isin(np.arange(mj.njnt), mj.dof_jntid[wrong])
            name = named(mj, {"dof": "joint", "jnt": "joint"}.get(kind, kind), wrong)
            raise ValueError(f"{name} has {what}, which is not supported: remove it")
    _check_impedances(mj)
    aside = (mj.wrap_type == mujoco.mjtWrap.mjWRAP_CYLINDER) & (mj.wrap_prm >= 0.0)  # wrap_prm: the side site
    if np.any(aside):
        wrapped = np.isin(np.arange(mj.ngeom), mj.wrap_objid[aside])
        raise ValueError(
            f"a tendon wraps {named(mj, 'geom', wrapped)}, a cylinder, with a sidesite, where MJX takes another path "
            "than MuJoCo: remove the sidesite"
        )
    for w in np.flatnonzero((mj.wrap_type == mujoco.mjtWrap.mjWRAP_SPHERE) & (mj.wrap_prm >= 0.0)):
        geom, site = mj.wrap_objid[w], int(mj.wrap_prm[w])
        apart = float(np.linalg.norm(mj.site_pos[site] - mj.geom_pos[geom]))
        if mj.geom_bodyid[geom] != mj.site_bodyid[site] or apart < mj.geom_size[geom, 0]:
            raise ValueError(
                f"a tendon wraps {named(mj, 'geom', np.arange(mj.ngeom) == geom)}, a sphere, with a sidesite that is "
                "inside it or on another body, where MJX has no finite derivative or takes another path than MuJoCo: "
                "move the sidesite outside, on the sphere's body"
            )


def _check_impedances(mj: mujoco.MjModel) -> None:
    """Raises ValueError for a power of an impedance with which MJX has no finite derivative beyond its width."""
    for kind, fields in {
        "joint": ("jnt_solimp", "dof_solimp"), "geom": ("geom_solimp",), "pair": ("pair_solimp",),
        "equality": ("eq_solimp",), "tendon": ("tendon_solimp_lim", "tendon_solimp_fri"),
    }.items():  # fmt: skip
        for field in fields:
            power = getattr(mj, field)[:, 4]
            wrong = (power > 1.0) & (power != np.round(power))
            if np.any(wrong):
                found = power[wrong][0]
                wrong = np.isin(np.arange(mj.njnt), mj.dof_jntid[wrong]) if field.startswith("dof") else wrong
                raise ValueError(
                    f"{named(mj, kind, wrong)} has a solimp with the power {found:g}, with which the gradient is not "
                    "finite: give 1, 2 or another integer"
                )


def _check_margins(mj: mujoco.MjModel) -> None:
    """Raises ValueError for limits whose two margins overlap: MJX has one row of constraints for both sides."""
    lines = np.isin(mj.jnt_type, (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE))
    for kind, limited in (("jnt", (mj.jnt_limited != 0) & lines), ("tendon", mj.tendon_limited != 0)):
        low, high = getattr(mj, f"{kind}_range").reshape(-1, 2).T
        wrong = limited & (2.0 * getattr(mj, f"{kind}_margin") > high - low)
        if np.any(wrong):
            raise ValueError(
                f"{named(mj, kind.replace('jnt', 'joint'), wrong)} has a margin of more than half its range, for which "
                "MJX has one constraint where MuJoCo has two: give a smaller margin"
            )


def _check_constraints(mj: mujoco.MjModel, penalty: bool) -> None:
    if not penalty:
        _check_margins(mj)
        return
    uneven = mj.pair_friction[:, 0] != mj.pair_friction[:, 1]
    if np.any(uneven):
        raise ValueError(
            f"{named(mj, 'pair', uneven)} has two coefficients of sliding friction, but a Penalty has one: "
            "make them equal"
        )
    touches = (mj.geom_contype | mj.geom_conaffinity) != 0
    for kind, wrong in (("pair", mj.pair_dim > 3), ("geom", (mj.geom_condim > 3) & touches)):
        if np.any(wrong):
            raise ValueError(
                f"{named(mj, kind, wrong)} has a condim above 3, but a Penalty has no torsional or rolling "
                f"friction: give that {kind} condim 3"
            )
    if is_disabled(mj, "LIMIT") or is_disabled(mj, "CONSTRAINT"):
        raise ValueError(
            "the model disables limits or all constraints, which a Penalty does not: remove the flag "
            "and unwanted ranges and contacts"
        )
    ball = (mj.jnt_limited != 0) & (mj.jnt_type == mujoco.mjtJoint.mjJNT_BALL)
    if np.any(ball):
        raise ValueError(
            f"{named(mj, 'joint', ball)} is a ball joint with a limit, which a Penalty does not support: remove the "
            "limit"
        )
    if mj.neq or np.any(mj.dof_frictionloss) or np.any(mj.tendon_limited) or np.any(mj.tendon_frictionloss):
        raise ValueError(
            "the model has equality constraints, dry friction or tendon limits, which a Penalty does not support: "
            "remove them, or load it without a Penalty"
        )


def named(mj: mujoco.MjModel, kind: str, wrong: np.ndarray) -> str:
    """The first element of a kind for which ``wrong`` is true, by its name or id."""
    number = int(np.flatnonzero(wrong)[0])
    name = mujoco.mj_id2name(mj, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), number)
    return f"{kind} {name!r}" if name else f"{kind} number {number}"


__all__ = [
    "LIMITS", "check_model", "compile_model", "is_disabled", "limit", "lone_dofs", "named", "number", "numeric",
    "own_pairs",
]  # fmt: skip
