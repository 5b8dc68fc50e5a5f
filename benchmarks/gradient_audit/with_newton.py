"""Newton in the audit: the two solvers that its documentation marks as differentiable, all states kept, one tape.

Contacts are found anew in every substep and kept in buffers of their own, since a tape must not see them overwritten.
Newton computes in float32.
"""

from importlib.metadata import version

import audit_scenes as s
import newton
import numpy as np
import warp as wp
from audit_protocol import NotSupported, Problem

wp.config.quiet = True

VERSION = version("newton")
VARIANTS = {
    "Newton (SemiImplicit)": "SolverSemiImplicit, CollisionPipeline, wp.Tape",
    "Newton (Featherstone)": "SolverFeatherstone, CollisionPipeline, wp.Tape",
}
DAMPING = 50.0
"""Normal force per approaching speed [N s/m]; Newton has no damping by depth."""
JOINT_DT, JOINT_DAMPING = 5e-4, 1.0
"""Of SemiImplicit, whose joints are springs and dampers: at 1 ms and its default of 100 N s/m the leg blows up."""
floats = wp.array(dtype=float)


@wp.kernel
def set_velocities(p: floats, axis: wp.vec3, body_qd: wp.array(dtype=wp.spatial_vector)):
    body_qd[wp.tid()] = wp.spatial_vector(p[0] * axis, wp.vec3(0.0))


@wp.kernel
def set_entry(p: floats, i: int, at: int, out: floats):
    out[at] = p[i]


@wp.kernel
def set_all(p: floats, i: int, out: floats):
    out[wp.tid()] = p[i]


@wp.kernel
def box_outcome(q: wp.array(dtype=wp.transform), out: floats):
    out[0] = wp.transform_get_translation(q[0])[0]


@wp.kernel
def leg_outcome(q: wp.array(dtype=wp.transform), out: floats):
    """The leg turns about -y: its quaternion is (0, -sin, 0, cos) of half the angle."""
    turn = wp.transform_get_rotation(q[1])
    out[0] = wp.transform_get_translation(q[0])[2] + 0.4 * wp.atan2(-turn[1], turn[3])


def shape_config(friction: float, density: float = 0.0):
    return newton.ModelBuilder.ShapeConfig(
        ke=s.CONTACT_STIFFNESS, kd=DAMPING, kf=s.FRICTION_DAMPING, mu=friction, density=density
    )


def box_model() -> newton.ModelBuilder:
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -s.GRAVITY))
    half = s.BOX_HALF_SIZE
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, half), wp.quat_identity()))
    builder.add_shape_box(body, hx=half, hy=half, hz=half, cfg=shape_config(0.3, 1.0 / (2 * half) ** 3))
    builder.add_ground_plane(cfg=shape_config(0.3))
    return builder


def leg_model() -> newton.ModelBuilder:
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -s.GRAVITY))
    height, angle = s.LEG_START
    up = wp.transform(wp.vec3(0.0, 0.0, height), wp.quat_identity())
    turned = wp.transform(wp.vec3(0.0, 0.0, height), wp.quat_from_axis_angle(wp.vec3(0.0, -1.0, 0.0), angle))
    hip, leg = builder.add_link(xform=up), builder.add_link(xform=turned)
    inside = newton.ModelBuilder.ShapeConfig(density=s.HIP_MASS / (4 / 3 * np.pi * 0.05**3), collision_group=0)
    builder.add_shape_sphere(hip, radius=0.05, cfg=inside)
    foot = wp.transform(wp.vec3(0.0, 0.0, -s.LEG_LENGTH), wp.quat_identity())
    solid = shape_config(s.FOOT_FRICTION, s.FOOT_MASS / (4 / 3 * np.pi * s.FOOT_RADIUS**3))
    builder.add_shape_sphere(leg, xform=foot, radius=s.FOOT_RADIUS, cfg=solid)
    free = {"armature": 0.0, "limit_ke": 0.0, "limit_kd": 0.0}
    slider = builder.add_joint_prismatic(-1, hip, parent_xform=up, axis=wp.vec3(0.0, 0.0, 1.0), **free)
    hinge = builder.add_joint_revolute(hip, leg, axis=wp.vec3(0.0, -1.0, 0.0), **free)
    builder.add_articulation([slider, hinge])
    builder.joint_q[1] = angle
    builder.add_ground_plane(cfg=shape_config(s.FOOT_FRICTION))
    return builder


class Rigid:
    """A scene; states, controls and contacts of all substeps are kept, which the tape needs."""

    def __init__(self, scene: str, featherstone: bool):
        self.is_leg, self.reduced = scene == "foot", featherstone
        self.dt = JOINT_DT if self.is_leg and not featherstone else s.RIGID_DT
        self.steps = s.substeps(scene, self.dt)
        self.model = (leg_model() if self.is_leg else box_model()).finalize(device="cpu", requires_grad=True)
        if featherstone:
            self.solver = newton.solvers.SolverFeatherstone(self.model, angular_damping=0.0)
        else:
            self.solver = newton.solvers.SolverSemiImplicit(
                self.model, angular_damping=0.0, joint_attach_kd=JOINT_DAMPING
            )
        self.states = [self.model.state() for _ in range(self.steps + 1)]
        self.control = self.model.control()
        self.pipeline = newton.CollisionPipeline(self.model, rigid_contact_max=8)
        self.contacts = [self.pipeline.contacts() for _ in range(self.steps)]
        self.p = wp.zeros(2, dtype=float, requires_grad=True, device="cpu")
        self.out = wp.zeros(1, dtype=float, requires_grad=True, device="cpu")
        newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, self.states[0])

    def start(self) -> None:
        first = self.states[0]
        axis = wp.vec3(0.0, 0.0, 1.0) if self.is_leg else wp.vec3(1.0, 0.0, 0.0)
        wp.launch(set_velocities, self.model.body_count, inputs=[self.p, axis, first.body_qd])
        wp.launch(set_entry, 1, inputs=[self.p, 0, 0, first.joint_qd])
        if self.is_leg:
            wp.launch(set_entry, 1, inputs=[self.p, 1, 1, self.control.joint_f])
        else:
            wp.launch(set_all, self.model.shape_count, inputs=[self.p, 1, self.model.shape_material_mu])

    def run(self) -> None:
        self.start()
        for t in range(self.steps):
            self.states[t].clear_forces()
            self.pipeline.collide(self.states[t], self.contacts[t])
            self.solver.step(self.states[t], self.states[t + 1], self.control, self.contacts[t], self.dt)
        wp.launch(leg_outcome if self.is_leg else box_outcome, 1, inputs=[self.states[-1].body_q, self.out])

    def value(self, p: np.ndarray) -> float:
        self.p.assign(p.astype(np.float32))
        self.run()
        return float(self.out.numpy()[0])

    def gradient(self, p: np.ndarray) -> np.ndarray:
        self.p.assign(p.astype(np.float32))
        tape = wp.Tape()
        with tape:
            self.run()
        tape.backward(self.out)
        found = self.p.grad.numpy().astype(np.float64)
        tape.zero()
        return found


def build(variant: str, scene: str) -> Problem:
    featherstone = "Featherstone" in variant
    if scene in ("throw", "press", "slide"):
        raise NotSupported("SolverImplicitMPM is marked as not differentiable")
    if scene == "drop":
        raise NotSupported("its MPM, SolverImplicitMPM, is marked as not differentiable")
    made = Rigid(scene, featherstone)
    return Problem(made.value, made.gradient, "float32", VARIANTS[variant])
