"""A worker for ``thin_speed.py``: its scene through Newton's ``SolverSemiImplicit``, Warp's cloth, on a CPU.

It needs ``newton`` and ``warp-lang``, not rewax. Collisions with the sphere are found every 8 substeps, as Newton's
examples do it once per frame. ``self`` adds ``enable_tri_contact``, Warp's contact of the cloth with itself. ``vbd``
and ``xpbd`` are Newton's other solvers of cloth.

    python thin_newton.py NUM_TRIANGLES [self | vbd | xpbd]
"""

import sys

import newton  # pyright: ignore[reportMissingImports]
import numpy as np
import thin_scene as scene
import warp as wp  # pyright: ignore[reportMissingImports]

EVERY = 8


@wp.kernel
def mean(x: wp.array(dtype=wp.vec3), axis: int, share: float, loss: wp.array(dtype=float)):  # pyright: ignore
    wp.atomic_add(loss, 0, share * x[wp.tid()][axis])


class Worker:
    """One sheet and its sphere."""

    def __init__(self, num_triangles: int, kind: str = "", on_floor: bool = False) -> None:
        wp.init()
        self.num_triangles = num_triangles
        self.x, self.v = scene.start(num_triangles, on_floor)
        touch, a = scene.contact(num_triangles), scene.cell(num_triangles)
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, scene.GRAVITY, 0.0))
        config = newton.ModelBuilder.ShapeConfig(
            ke=touch["stiffness"], kd=touch["damping"], kf=touch["friction_damping"], mu=touch["friction"], margin=0.0
        )
        if on_floor:
            builder.add_ground_plane(height=scene.RADIUS, cfg=config)
        else:
            builder.add_shape_sphere(body=-1, radius=scene.RADIUS, cfg=config)
        rest = scene.start(num_triangles, True)[0]
        builder.add_cloth_mesh(
            pos=wp.vec3(0.0), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(0.0), vertices=[wp.vec3(*p) for p in rest],
            indices=scene.triangles(num_triangles).reshape(-1).tolist(), density=scene.DENSITY, tri_ke=scene.STIFFNESS,
            tri_ka=scene.STIFFNESS, tri_kd=0.0, tri_drag=0.0, tri_lift=0.0, edge_ke=scene.BENDING / a, edge_kd=0.0,
            particle_radius=scene.TOUCH,
        )  # fmt: skip
        if kind == "vbd":
            builder.color(include_bending=True)
        self.model = builder.finalize(device="cpu", requires_grad=True)
        self.model.soft_contact_ke, self.model.soft_contact_kd = touch["stiffness"], touch["damping"]
        self.model.soft_contact_kf, self.model.soft_contact_mu = touch["friction_damping"], touch["friction"]
        if kind != "xpbd":
            self.model.particle_grid = None
        if kind == "vbd":
            self.solver = newton.solvers.SolverVBD(self.model)
        elif kind == "xpbd":
            self.solver = newton.solvers.SolverXPBD(self.model)
        else:
            self.solver = newton.solvers.SolverSemiImplicit(self.model, enable_tri_contact=kind == "self")
        self.pipeline = newton.CollisionPipeline(self.model, soft_contact_margin=2.0 * scene.TOUCH)
        self.control = self.model.control()
        self.states: list = []
        self.contacts: list = []
        self.by_sphere = 0.0
        self.loss = wp.zeros(1, dtype=float, device="cpu", requires_grad=True)

    def prepare(self, count: int) -> None:
        while len(self.states) < count + 1:
            self.states.append(self.model.state())
        while len(self.contacts) < -(-count // EVERY):
            self.contacts.append(self.pipeline.contacts())
        self.states[0].particle_q.assign(self.x)
        self.states[0].particle_qd.assign(self.v)

    def advance(self, count: int, keep: bool) -> wp.array:
        """Final positions; ``keep`` uses a state for each substep, as the tape needs it, else two in turns."""
        now = self.states[0]
        for t in range(count):
            other = self.states[t + 1 if keep else 1 - t % 2]
            if t % EVERY == 0:
                contacts = self.contacts[t // EVERY if keep else 0]
                self.pipeline.collide(now, contacts)
            now.clear_forces()
            self.solver.step(now, other, self.control, contacts, scene.DT)
            now = other
        return now.particle_q

    def forward(self, count: int, axis: int = 1) -> dict:
        self.prepare(1)
        return {"height": float(self.advance(count, False).numpy()[:, axis].mean(dtype=np.float64))}

    def backward(self, count: int, axis: int = 1) -> dict:
        self.prepare(count)
        self.loss.zero_()
        tape = wp.Tape()
        with tape:
            x = self.advance(count, True)
            wp.launch(mean, self.model.particle_count, inputs=[x, axis, 1.0 / self.model.particle_count, self.loss])
        tape.backward(self.loss)
        slope = self.states[0].particle_qd.grad.numpy().astype(np.float64)
        height = float(self.loss.numpy()[0])
        self.by_sphere = float(self.model.shape_transform.grad.numpy()[0][1])
        tape.zero()
        return {"height": height, "gradient": slope.sum(axis=0).tolist()}

    def sphere(self, count: int) -> dict:
        """The derivative of the mean height by the sphere's height, by the tape and by central differences."""
        transforms, ends = self.model.shape_transform, []
        self.backward(count)
        before = transforms.numpy().copy()
        for sign in (1.0, -1.0):
            moved = before.copy()
            moved[0, 1] += sign * scene.STEP
            transforms.assign(moved)
            ends.append(self.forward(count)["height"])
        transforms.assign(before)
        return {"gradient": self.by_sphere, "difference": (ends[0] - ends[1]) / (2.0 * scene.STEP)}

    def slide(self, count: int) -> dict:
        """The derivative of the mean x by a velocity along x of all vertices, as a flat sheet lands on a floor."""
        other, ends = Worker(self.num_triangles, on_floor=True), []
        gradient = other.backward(count, 0)["gradient"][0]
        for sign in (1.0, -1.0):
            other.v = self.v * [0.0, 0.0, 0.0] + [sign * scene.STEP, scene.SPEED, 0.0]
            ends.append(other.forward(count, 0)["height"])
        return {"gradient": gradient, "difference": (ends[0] - ends[1]) / (2.0 * scene.STEP)}


if __name__ == "__main__":
    scene.serve(Worker(int(sys.argv[1]), *sys.argv[2:]))
