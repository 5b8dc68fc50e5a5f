"""What scenes of cloth and ropes refuse."""

import numpy as np
import pytest
from thin_bodies import CLOTH, SHEET, cloth_scene, rope_scene

from rewax.physics import thin
from rewax.physics.contact.penalty import Ground

MOBIUS = thin.ThinMesh(vertices=np.eye(4, 3), triangles=np.asarray([[0, 1, 2], [0, 1, 3]]))


REFUSED = [
    (lambda: cloth_scene(dt=1.0), "above the largest stable"),
    (lambda: cloth_scene(dt=0.0), "dt is 0.0"),
    (lambda: cloth_scene(held=[99]), "held has indices"),
    (lambda: cloth_scene(held=[1, 1]), "different indices"),
    (lambda: cloth_scene(drag=-1.0), "drag is -1.0"),
    (lambda: cloth_scene(ground=Ground(normal=(0, 1, 0))), "contact is None"),
    (lambda: cloth_scene(rope=thin.Rope(stretch=1.0, density=1.0)), "rope is given"),
    (lambda: thin.make_scene(mesh=SHEET, dt=1e-4), "cloth is None"),
    (lambda: rope_scene(stretch=-1.0), "rope.stretch is -1.0"),
    (lambda: rope_scene(bending=np.ones(3)), r"give a number or an array of shape \(7,\)"),
    (lambda: cloth_scene(cloth=thin.Cloth(warp=1.0, weft=1.0, coupling=1.0, shear=1.0, density=1.0)), "sqrt"),
    (
        lambda: cloth_scene(
            cloth=thin.Cloth(warp=9.0, weft=1.0, shear=1.0, density=1.0), law=thin.MembraneLaw.NEO_HOOKEAN
        ),
        "law is NEO_HOOKEAN",
    ),
    (lambda: cloth_scene(MOBIUS), "twice in the same direction"),
    (lambda: rope_scene(thin.rope(np.zeros((3, 3)))), "no length"),
    (
        lambda: rope_scene(thin.ThinMesh(vertices=np.eye(2, 3), segments=np.asarray([[0, 1], [1, 0]]))),
        "two between the same vertices",
    ),
    (lambda: cloth_scene(warp=(0.0, 0.0, 0.0)), "warp is the zero vector"),
    (lambda: cloth_scene(warp=(np.nan, 0.0, 0.0)), r"warp\[0\] is nan"),
    (lambda: cloth_scene(thin.ThinMesh(vertices=np.eye(4, 3), triangles=[[0, 1, 2]])), "without an element"),
    (lambda: cloth_scene(thin.ThinMesh(vertices=np.zeros((3, 3)), triangles=[[0, 1, 2]])), "flat or mirrored"),
    (lambda: thin.sheet(-1.0, 1.0, 2, 2), "width is -1.0"),
    (lambda: thin.isotropic_cloth(**CLOTH | {"poissons_ratio": 0.6}), "poissons_ratio is 0.6"),
]


@pytest.mark.parametrize(("build", "message"), REFUSED)
def test_illegal_scenes_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
