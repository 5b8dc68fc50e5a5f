"""Bytecode on disk: read instead of made, for exactly the same function, rules of differentiation and types."""

import functools
import os
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER

from rewax.lowering import bytecode_cache, interpreted, kernels, machine, pointwise
from rewax.lowering.assembled import assembled as assembled_sums
from rewax.lowering.operations import UnsupportedError
from rewax.lowering.stencils import Stencil, gather

X = jnp.array([0.3, -0.7, 1.1], jnp.float32)


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """JAX's cache in an empty folder, where the bytecode goes too."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    monkeypatch.setattr(bytecode_cache, "_remove_oldest", lambda home: None)
    yield tmp_path / "rewax-bytecode"
    jax.config.update("jax_compilation_cache_dir", before)


def in_a_new_process():
    """What this process remembers is forgotten; the files stay."""
    jax.clear_caches()
    machine._target.cache_clear()
    kernels.target_of.cache_clear()


@pytest.fixture
def assembled(monkeypatch):
    """The rules that were assembled, not read."""
    found = []

    def spy(module, name):
        make = getattr(module, name)

        def call(which, *args):
            found.append(which)
            return make(which, *args)

        monkeypatch.setattr(module, name, call)

    spy(machine, "_assembled")
    spy(kernels, "bytecode_of")
    return found


def law(shared, elements):
    return {"y": jnp.sin(elements["x"]) * shared["gain"] + 2.0, "z": jnp.stack([elements["x"] ** 2, -elements["x"]])}


def mixed(x):
    return jnp.tanh(x) * x[::-1] + jnp.where(x > 0, x**3, 0.0)


def value_and_derivatives(function, x=X):
    tangent = jax.jvp(function, (x,), (jnp.ones_like(x),))[1]
    return function(x), tangent, jax.grad(lambda x: sum(map(jnp.sum, jax.tree.leaves(function(x)))))(x)


@NEEDS_COMPILER
@pytest.mark.parametrize("kind", ["lanes", "blocks"])
def test_bytecode_of_an_earlier_process_is_read(kind, kept, assembled):
    many = pointwise(law)
    function = interpreted(mixed) if kind == "lanes" else lambda x: many({"gain": x.sum()}, {"x": x})
    first = value_and_derivatives(function)
    assert sorted(assembled) == ["cotangent", "tangent", "value"]
    assert len(list(kept.iterdir())) == 3
    in_a_new_process()
    second = value_and_derivatives(function)
    assert len(assembled) == 3  # nothing was assembled again
    jax.tree.map(np.testing.assert_array_equal, first, second)


@NEEDS_COMPILER
@pytest.mark.parametrize("kind", ["lanes", "blocks"])
def test_derivatives_by_different_arguments_are_kept_apart(kind, kept):
    """All types are equal; only which argument varies or is differentiated differs."""

    def product(a, b):
        return jnp.sin(a) * b**2

    many = pointwise(lambda shared, elements: product(*elements) + product(*elements[::-1]) * shared)
    function = interpreted(product) if kind == "lanes" else lambda a, b: many(jnp.float32(2.0), (a, b))
    reference = product if kind == "lanes" else lambda a, b: product(a, b) + 2.0 * product(b, a)
    y = X + 0.5

    def gradient(f, argnums):
        return jax.jit(jax.grad(lambda *args: f(*args).sum(), argnums))(X, y)

    expected = {argnums: gradient(reference, argnums) for argnums in (0, 1, (0, 1))}
    for _ in range(2):
        for argnums, slopes in expected.items():
            in_a_new_process()
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), gradient(function, argnums), slopes)


def key(function, *rest, x=X):
    return bytecode_cache.key_of(jax.make_jaxpr(function)(x), *rest)


def test_keys_are_those_of_the_content(kept):
    """Equal functions share a key; whatever changes the bytecode changes it."""
    constant = np.arange(3.0, dtype=np.float32)
    other = constant.copy()
    other[1] += 1e-6
    functions = [
        mixed,
        lambda x: mixed(x) + 1.0,
        lambda x: mixed(x) + (1.0 + 1e-6),
        lambda x: mixed(x) * constant,
        lambda x: mixed(x) * other,
        lambda x: mixed(x)[::-1],
        lambda x: jax.lax.scan(lambda a, b: (a + b, a), x[0], x, length=3)[0] * x,
        lambda x: jax.lax.scan(lambda a, b: (a + b, a), x[0], x, length=3, reverse=True)[0] * x,
        jax.jit(lambda x: x + x),
        lambda x: jax.nn.relu(x),
        lambda x: jax.nn.silu(x),
    ]
    keys = [key(function) for function in functions]
    assert None not in keys
    assert [keys.index(k) for k in keys] == list(range(len(keys)))
    assert key(lambda x: mixed(x)) == keys[0]
    assert key(lambda x: mixed(x) * constant.copy()) == keys[3]
    rest = [key(mixed, "value"), key(mixed, "tangent"), key(mixed, (True,)), key(mixed, (1,)), key(mixed, x=X[:2])]
    assert len({*keys, *rest}) == len(keys) + len(rest)
    with jax.default_matmul_precision("float32"):
        assert key(mixed) != keys[0]


def with_slope(slope, module):
    """A function whose derivative is what its author says, and not in its jaxpr."""

    @jax.custom_jvp
    def doubled(x):
        return 2.0 * x

    def rule(primals, tangents):
        return doubled(*primals), slope * tangents[0]

    rule.__module__ = doubled.__module__ = module
    doubled.fun.__module__ = module
    doubled.defjvp(rule)
    return doubled


def test_rules_of_differentiation_are_part_of_the_key(kept):
    ours = "rewax.physics.anything"
    assert key(with_slope(2.0, ours)) == key(with_slope(2.0, ours)) is not None
    assert key(with_slope(2.0, ours)) != key(with_slope(3.0, ours))
    assert key(with_slope(jnp.float32(2.0), ours)) != key(with_slope(jnp.float32(3.0), ours))


@pytest.mark.parametrize("edited", ["rewax.physics.anything", "rewax.lowering"])
def test_an_edit_of_a_rule_or_of_the_compiler_changes_the_key(edited, kept, monkeypatch):
    function, sources = with_slope(2.0, "rewax.physics.anything"), bytecode_cache.sources
    before, plain = key(function), key(mixed)
    monkeypatch.setattr(bytecode_cache, "sources", lambda module: sources(module) + "edited" * (module == edited))
    assert key(function) != before
    assert (key(mixed) != plain) == (edited == "rewax.lowering")


def test_sources_that_are_newer_than_the_process_have_no_key(kept, monkeypatch):
    """The process runs the code that it imported, and would keep its bytecode under the name of the new code."""
    assert key(mixed) is not None
    imported = bytecode_cache._file_of("rewax.lowering.operations").stat().st_mtime - 1.0
    bytecode_cache.sources.cache_clear()
    monkeypatch.setattr(bytecode_cache, "_IMPORTED", imported)
    assert key(mixed) is None


def test_sources_that_were_replaced_by_a_copy_with_its_old_time_have_no_key(tmp_path, monkeypatch):
    path = tmp_path / "copied.py"
    monkeypatch.setattr(bytecode_cache, "_file_of", lambda module: path)
    monkeypatch.setattr(bytecode_cache, "_IMPORTED", time.time() - 1.0)
    path.write_text("a = 1\n")
    os.utime(path, (1000, 1000))
    with pytest.raises(bytecode_cache._UnknownError):
        bytecode_cache.sources.__wrapped__("rewax.copied")


@NEEDS_COMPILER
def test_rules_of_others_are_not_kept(kept, assembled):
    """Their sources may change without a change of the jaxpr: the derivative would be an old one, in silence."""
    for slope in (2.0, 3.0):
        in_a_new_process()
        function = interpreted(with_slope(slope, "somebody.else"))
        np.testing.assert_array_equal(jax.grad(lambda x, f=function: f(x).sum())(X), jnp.full(3, slope))
    assert assembled == ["value", "cotangent"] * 2
    assert not kept.exists()


@pytest.mark.parametrize(
    "value",
    [object(), lambda x: x, jax.random.key(0), np.array([None]), functools.partial(lambda x: x), {"a": [open]}],
    ids=lambda value: type(value).__name__,
)
def test_what_is_not_known_has_no_key(value, kept):
    assert key(mixed, value) is None


def total(shared, at):
    del shared
    return tuple(corner * at[1][0] for corner in at[1])


def test_meshes_of_one_size_have_keys_of_their_own(kept, monkeypatch):
    """They print alike, and their programs differ in nothing that the jaxpr shows."""
    monkeypatch.setattr(total, "__module__", "rewax.physics.anything")
    many, meshes = assembled_sums(total), [Stencil(np.array(t), 4) for t in ([[0, 1], [1, 2]], [[2, 3], [3, 0]])]
    x = jnp.arange(4.0)
    for function in (lambda mesh, x: gather(mesh, (x,))[0], lambda mesh, x: many(mesh, (), (), x)):
        first, again, other = (key(functools.partial(function, mesh), x=x) for mesh in (meshes[0], *meshes))
        assert first is not None and first == again != other


def test_an_object_of_the_package_that_does_not_say_its_content_has_no_key(kept):
    def printed_alike(self):
        return "Kind()"

    kind = type("Kind", (), {"__repr__": printed_alike, "__module__": "rewax.physics.anything"})
    assert key(mixed, kind()) is None


def test_a_function_that_refers_to_itself_has_a_key(kept):
    def rule(primals, tangents):
        assert rule is not None
        return jnp.sin(primals[0]), tangents[0]

    rule.__module__ = "rewax.physics.anything"
    assert key(mixed, rule) == key(mixed, rule) is not None


def refused():
    raise UnsupportedError("it has the operation sort")


def test_refusals_are_kept(kept):
    for make in (refused, lambda: pytest.fail("it was asked again")):
        with pytest.raises(UnsupportedError, match=r"^it has the operation sort$"):
            bytecode_cache.remembered("refusal", make)


VALUE = (np.dtype(np.float32), np.arange(5, dtype=np.int32), ((3, 1), True, "a"), None)


@pytest.mark.parametrize("damage", [lambda c: c[:40], lambda c: c[:-1] + bytes([c[-1] ^ 1]), lambda c: b"", None])
def test_a_damaged_file_is_made_again(damage, kept):
    bytecode_cache.remembered("name", lambda: VALUE)
    (path,) = kept.iterdir()
    if damage:
        path.write_bytes(damage(path.read_bytes()))
    found = bytecode_cache.remembered("name", lambda: VALUE if damage else pytest.fail("it was made again"))
    jax.tree.map(np.testing.assert_array_equal, found[1:3], VALUE[1:3])
    assert found[0] == VALUE[0] and found[3] is None
    bytecode_cache.remembered("name", lambda: pytest.fail("it was not kept"))


def test_without_jax_cache_nothing_is_written(kept):
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        assert bytecode_cache.folder() is None and key(mixed) is None
        assert bytecode_cache.remembered(None, lambda: 1) == 1
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    jax.config.update("jax_compilation_cache_dir", "gs://bucket/cache")
    assert bytecode_cache.folder() is None
    assert not kept.exists()


def test_a_folder_that_cannot_be_written_to_is_no_error(kept):
    kept.write_text("a file, where the folder should be")
    assert bytecode_cache.remembered("name", lambda: VALUE) is VALUE


def test_the_oldest_files_go(tmp_path, monkeypatch):
    monkeypatch.setattr(bytecode_cache, "_LARGEST", 1000)
    for k in range(12):
        path = tmp_path / f"{k}.npz"
        path.write_bytes(bytes(100))
        os.utime(path, (1000 + k, 1000 + k))
    bytecode_cache._remove_oldest.__wrapped__(tmp_path)
    assert sorted(int(path.stem) for path in tmp_path.iterdir()) == [7, 8, 9, 10, 11]
    bytecode_cache._remove_oldest.__wrapped__(tmp_path)
    assert len(list(tmp_path.iterdir())) == 5


def test_sources_are_those_that_a_module_imports(tmp_path, monkeypatch):
    """Also inside functions, and those that these import; a package means all that is in it."""
    files = {
        "a": "import jax\nfrom rewax.kit import b\n",
        "b": "def f():\n    from rewax.kit.c import g\n    return g\n",
        "c": "g = 1\n",
        "d": "import rewax.kit.a\n",
        "__init__": '"""A kit."""\n',
    }
    monkeypatch.setattr(bytecode_cache, "_file_of", lambda module: found.get(module))
    monkeypatch.setattr(bytecode_cache, "_IMPORTED", float("inf"))  # the test writes them later
    found = {f"rewax.kit.{name}": tmp_path / f"{name}.py" for name in files}
    found["rewax.kit"] = found.pop("rewax.kit.__init__")

    def hashes():
        return {name: bytecode_cache.sources.__wrapped__(name) for name in found}

    def changed(name):
        for each, text in files.items():
            (tmp_path / f"{each}.py").write_text(text)
        before = hashes()
        with (tmp_path / f"{name}.py").open("a") as file:
            file.write("# other\n")
        return {
            each.removeprefix("rewax.kit").strip(".") for each, digest in hashes().items() if digest != before[each]
        }

    assert changed("c") == {"a", "b", "c", "d", ""}
    assert changed("b") == {"a", "b", "d", ""}
    assert changed("d") == {"d", ""}
    monkeypatch.undo()
    assert bytecode_cache.sources("rewax.lowering") != bytecode_cache.sources("rewax.physics.mpm.scene")
