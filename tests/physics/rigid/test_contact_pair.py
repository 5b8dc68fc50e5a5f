"""A contact pair as an object: what it refuses, in which sentence; shapes that its function may return; frames."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics import rigid
from rewax.physics.rigid import ContactPair, Geom
from rewax.physics.rigid.contact_pair import contact_frame, find

BALLS = "<mujoco><worldbody>" + 2 * '<body><freejoint/><geom size=".1"/></body>' + "</worldbody></mujoco>"
KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box")


def spheres(first, second):
    across = second.position - first.position
    length = jnp.sqrt(jnp.sum(across**2))
    distance, normal = length - first.size[0] - second.size[0], across / length
    return distance, first.position + normal * (first.size[0] + 0.5 * distance), normal


def returning(*result):
    return ContactPair(("sphere", "sphere"), 2, lambda first, second: result if len(result) != 1 else result[0])


REFUSED = {
    "kind": (lambda: ContactPair(("sphere", "ball"), 1, spheres), f"kinds is ('sphere', 'ball'): give two of {str(KINDS)[1:-1]}"),
    "one": (lambda: ContactPair("box", 1, spheres), f"kinds is 'box': give two of {str(KINDS)[1:-1]}"),
    "mesh": (lambda: ContactPair(("box", "mesh"), 1, spheres), f"kinds is ('box', 'mesh'): give two of {str(KINDS)[1:-1]}"),
    "planes": (lambda: ContactPair(("plane", "plane"), 1, spheres), "kinds is ('plane', 'plane'), which never touch: give another kind beside plane"),
    "order": (lambda: ContactPair(("box", "sphere"), 1, spheres), "kinds is ('box', 'sphere'): give ('sphere', 'box'), MuJoCo's order, and a function of these"),
    "count": (lambda: ContactPair(("sphere", "box"), 0, spheres), "num_contacts of the contact pair sphere-box is 0: give an integer, at least 1"),
    "half": (lambda: ContactPair(("sphere", "box"), 1.5, spheres), "num_contacts of the contact pair sphere-box is 1.5: give an integer, at least 1"),
    "function": (lambda: ContactPair(("sphere", "box"), 1, None), "function of the contact pair sphere-box is None: give a function of two geoms"),
    "no pair": (lambda: rigid.load(BALLS, contact_pairs=[spheres]), f"contact_pairs holds {spheres!r}: give rigid.ContactPair(kinds, num_contacts, function)"),
    "twice": (lambda: rigid.load(BALLS, contact_pairs=2 * [ContactPair(("sphere", "sphere"), 1, spheres)]), "contact_pairs holds contact pair sphere-sphere twice: leave one out"),
    "result": (lambda: rigid.load(BALLS, contact_pairs=[returning(jnp.zeros(2))]), "the function of the contact pair sphere-sphere returned one array: return distance, point and normal"),
    "distance": (lambda: rigid.load(BALLS, contact_pairs=[returning(jnp.zeros(3), jnp.zeros((2, 3)), jnp.zeros(3))]), "the function of the contact pair sphere-sphere returned a distance of shape (3,): return shape (2,), for num_contacts=2"),
    "point": (lambda: rigid.load(BALLS, contact_pairs=[returning(jnp.zeros(2), jnp.zeros(3), jnp.zeros(3))]), "the function of the contact pair sphere-sphere returned a point of shape (3,): return shape (2, 3), for num_contacts=2"),
    "normal": (lambda: rigid.load(BALLS, contact_pairs=[returning(jnp.zeros(2), jnp.zeros((2, 3)), jnp.zeros((3, 3)))]), "the function of the contact pair sphere-sphere returned a normal of shape (3, 3): return shape (2, 3), or (3,), or (2, 3, 3), for num_contacts=2"),
    "integers": (lambda: rigid.load(BALLS, contact_pairs=[returning(jnp.zeros(2, int), jnp.zeros((2, 3)), jnp.zeros(3))]), "the function of the contact pair sphere-sphere returned a distance of dtype int32: return floats"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_bad_pairs_are_refused(what):
    make, sentence = REFUSED[what]
    with pytest.raises(ValueError, match="^" + re.escape(sentence) + "$"):
        make()


@pytest.mark.parametrize("shared", [False, True])
def test_contacts_of_a_pair_follow_one_another(x64, shared):
    """Of two contacts of each of five pairs; one normal for both is as good as two."""
    normals = np.array([[1.0, 0, 0], [1.0, 0, 0]] if shared else [[1.0, 0, 0], [0, 0, -1.0]])

    def function(first, second):
        gap = second.position[0] - first.position[0]
        normal = jnp.asarray(normals[0] if shared else normals)
        return jnp.stack([gap, gap + 10]), jnp.stack([first.position, second.position]), normal

    geom = Geom(jnp.arange(15.0).reshape(5, 3), jnp.tile(jnp.eye(3), (5, 1, 1)), jnp.ones((5, 3)))
    other = geom._replace(position=geom.position + jnp.arange(5.0)[:, None])
    distance, point, frame = jax.jit(lambda *g: find(ContactPair(("box", "box"), 2, function), *g))(geom, other)
    np.testing.assert_allclose(distance, [0, 10, 1, 11, 2, 12, 3, 13, 4, 14])
    np.testing.assert_allclose(point[::2], geom.position)
    np.testing.assert_allclose(point[1::2], other.position)
    np.testing.assert_allclose(frame[:, 0], np.tile(normals, (5, 1)))
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (10, 1, 1)), atol=1e-15)


def test_frames_are_mujocos(x64):
    normal = np.random.default_rng(0).standard_normal((30, 3))
    normal[:3] = np.eye(3)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for ours, up in zip(np.asarray(contact_frame(jnp.asarray(normal))), normal, strict=True):
        tangent = np.array([0, 1, 0.0]) if -0.5 < up[1] < 0.5 else np.array([0, 0, 1.0])
        tangent -= up * (up @ tangent)
        tangent /= np.linalg.norm(tangent)
        np.testing.assert_allclose(ours, [up, tangent, np.cross(up, tangent)], atol=1e-12)


def test_models_with_the_same_pairs_share_programs():
    pair = ContactPair(("sphere", "sphere"), 1, spheres)
    plain, first, again = rigid.load(BALLS), rigid.load(BALLS, contact_pairs=[pair]), rigid.load(
        BALLS, contact_pairs=(ContactPair(["sphere", "sphere"], 1, spheres),)
    )  # fmt: skip
    assert first.static == again.static and hash(first.static) == hash(again.static)
    assert plain.static != first.static and jax.tree.structure(plain) != jax.tree.structure(first)


def test_a_pair_that_is_no_sequence_is_refused():
    pair = ContactPair(("sphere", "sphere"), 1, spheres)
    with pytest.raises(ValueError, match=re.escape("give a sequence, contact_pairs=(pair,) for one")):
        rigid.load(BALLS, contact_pairs=pair)
