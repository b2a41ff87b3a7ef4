"""Both forms of our convolution against XLA's own, in value and gradients."""

import functools
import pathlib
import subprocess
import sys
from concurrent import futures
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from jaxil import native
from jaxil.maths import convolution

with_and_without_jit: Any = chex.variants(with_jit=True, without_jit=True)

FEATURES = 32  # that the native form takes; multiples of it too


@pytest.fixture(scope="module", autouse=True)
def _native_form_is_there():
    assert native.problem() is None


def reference(images, kernel, bias, stride):
    z = lax.conv_general_dilated(
        images,
        kernel,
        (stride, stride),
        "VALID",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return jnp.maximum(z + bias[None, None, None], 0.0)


def draw(seed, images_shape, kernel_shape):
    """Returns images, kernel and bias, all normal."""
    rng = np.random.default_rng(seed)
    return tuple(
        jnp.asarray(rng.normal(size=shape), jnp.float32)
        for shape in (images_shape, kernel_shape, kernel_shape[3:])
    )


def value_and_gradients(convolve, arguments, stride):
    value, transpose = jax.vjp(lambda *x: convolve(*x, stride), *arguments)
    # Any cotangent will do that differs from place to place.
    places = jnp.arange(value.size, dtype=jnp.float32).reshape(value.shape)
    return (value, *transpose(jnp.sin(17.0 * places)))


def assert_same(arguments, stride, *, is_native):
    def ours(images, kernel, bias, stride):
        return convolution.convolve_relu(images, kernel, bias, stride, native=is_native)

    results, expected = (
        jax.jit(lambda *x, f=form: value_and_gradients(f, x, stride))(*arguments)
        for form in (ours, reference)
    )
    for ours_, theirs in zip(results, expected, strict=True):
        assert ours_.shape == theirs.shape
        scale = float(jnp.max(jnp.abs(theirs))) + 1e-3
        np.testing.assert_allclose(ours_ / scale, theirs / scale, atol=2e-5)


class ConvolveReluTest(chex.TestCase):
    @with_and_without_jit
    @parameterized.product(
        sizes=[(3, 1), (3, 2), (3, 4), (4, 4), (2, 2), (8, 4), (1, 1), (1, 2)],
        native=[False, True],
    )
    def test_equals_xla(self, sizes, native):
        size, stride = sizes
        arguments = draw(0, (2, 13, 13, 3), (size, size, 3, FEATURES))
        ours = self.variant(
            functools.partial(convolution.convolve_relu, stride=stride, native=native)
        )
        np.testing.assert_allclose(
            ours(*arguments), reference(*arguments, stride), rtol=1e-5, atol=1e-4
        )

    def test_tile_gradient_by_hand(self):
        # Windows of 2 see every pixel but a last, odd one.
        kernel = jnp.asarray([1.0, 10.0]).reshape(1, 2, 1, 1)
        cotangent = jnp.asarray([1.0, 2.0]).reshape(1, 1, 2, 1)
        gradient = convolution.tile_gradient(cotangent, kernel, (1, 5))
        np.testing.assert_array_equal(gradient.reshape(-1), [1, 10, 2, 20, 0])

    def test_native_by_hand(self):
        # One row of 3 pixels, a kernel of 2: of feature f it is (f, 1), its bias -12.
        f = jnp.arange(FEATURES, dtype=jnp.float32)
        kernel = jnp.stack([f, jnp.ones(FEATURES)]).reshape(1, 2, 1, FEATURES)
        images = jnp.asarray([1.0, 2.0, 3.0]).reshape(1, 1, 3, 1)
        bias = jnp.full(FEATURES, -12.0)
        value, to_all = jax.vjp(
            functools.partial(convolution.convolve_relu, stride=1, native=True),
            images,
            kernel,
            bias,
        )
        # 1 f + 2 - 12 and 2 f + 3 - 12: open from f = 11 and from f = 5 on.
        first, second = jnp.maximum(f - 10, 0), jnp.maximum(2 * f - 9, 0)
        np.testing.assert_array_equal(value[0, 0], jnp.stack([first, second]))
        to_images, to_kernel, to_bias = to_all(jnp.ones_like(value))
        opens = np.stack([np.arange(FEATURES) >= 11, np.arange(FEATURES) >= 5])
        np.testing.assert_array_equal(to_bias, opens.sum(0))
        np.testing.assert_array_equal(to_kernel[0, 0, 0], 1 * opens[0] + 2 * opens[1])
        np.testing.assert_array_equal(to_kernel[0, 1, 0], 2 * opens[0] + 3 * opens[1])
        # Pixel 0 meets f of the first window; pixel 2 meets 1 of the second.
        assert to_images[0, 0, 0, 0] == sum(range(11, 32))
        assert to_images[0, 0, 1, 0] == sum(range(5, 32)) + (32 - 11)
        assert to_images[0, 0, 2, 0] == 32 - 5

    def test_gradients_of_gradients_equal_xla(self):
        # As a gradient penalty on pixels needs them; 14 pixels leave some unused.
        arguments = draw(1, (2, 14, 14, 3), (4, 4, 3, 5))

        def penalty(convolve):
            def slope(images, *others):
                gradient = jax.grad(
                    lambda x: jnp.sum(jnp.sin(convolve(x, *others, 4)))
                )(images)
                return jnp.sum(jnp.square(gradient))

            return jax.grad(slope, argnums=(0, 1, 2))(*arguments)

        chex.assert_trees_all_close(
            penalty(convolution.convolve_relu),
            penalty(reference),
            rtol=1e-4,
            atol=2e-3,
        )

    def test_each_image_of_a_vmapped_batch_is_convolved(self):
        images, kernel, bias = draw(2, (3, 1, 5, 6, 2), (3, 3, 2, FEATURES))
        rows = jax.vmap(
            lambda x: convolution.convolve_relu(x, kernel, bias, 1, native=True)
        )(images)
        np.testing.assert_allclose(
            rows[:, 0], reference(images[:, 0], kernel, bias, 1), atol=1e-4
        )


@settings(derandomize=True, max_examples=25, deadline=None)
@given(data=st.data())
def test_value_and_gradients_at_any_size(data):
    stride = data.draw(st.sampled_from([1, 2, 4]), "stride")
    kernel = data.draw(st.tuples(st.integers(1, 5), st.integers(1, 5)), "kernel")
    size = [side + data.draw(st.integers(0, 20)) for side in kernel]
    channels = data.draw(st.sampled_from([1, 2, 9, 32, 64]), "channels")
    features = data.draw(st.sampled_from([1, 3, 32, 64]), "features")
    batch = data.draw(st.integers(1, 5), "batch")
    arguments = draw(stride, (batch, *size, channels), (*kernel, channels, features))
    assert_same(arguments, stride, is_native=data.draw(st.booleans(), "native"))


@settings(derandomize=True, max_examples=6, deadline=None)
@given(
    stride=st.sampled_from([2, 3, 4]),
    height=st.integers(4, 11),
    width=st.integers(4, 11),
)
def test_windows_that_do_not_overlap(stride, height, width):
    arguments = draw(0, (2, height, width, 2), (stride, stride, 2, 3))
    assert_same(arguments, stride, is_native=False)


@pytest.mark.parametrize(
    ("side", "kernel", "stride"),
    [(84, (3, 3, 9, 32), 2), (41, (3, 3, 32, 32), 1), (48, (4, 4, 9, 32), 4)],
)
def test_layers_of_the_presets(side, kernel, stride):
    assert_same(draw(0, (3, side, side, kernel[2]), kernel), stride, is_native=True)


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float32])
def test_what_the_native_form_does_not_take_is_xlas(dtype):
    features = 33 if dtype == jnp.float32 else FEATURES
    arguments = draw(0, (2, 8, 8, 3), (3, 3, 3, features))
    arguments = [x.astype(dtype) for x in arguments]

    def program(is_native):
        return str(
            jax.make_jaxpr(
                functools.partial(convolution.convolve_relu, stride=1, native=is_native)
            )(*arguments)
        )

    assert "conv_general_dilated" in program(True)
    assert "ffi_call" not in program(True)


@pytest.mark.parametrize("is_native", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_not_hidden(is_native, value):
    # Of three images the second has one such pixel; its windows show it, no others.
    images, kernel, bias = draw(5, (3, 5, 6, 2), (3, 3, 2, FEATURES))
    images = images.at[1, 2, 3, 0].set(value)
    run = jax.jit(
        functools.partial(convolution.convolve_relu, stride=1, native=is_native)
    )
    y, expected = run(images, kernel, bias), reference(images, kernel, bias, 1)
    np.testing.assert_array_equal(np.isfinite(y), np.isfinite(expected))
    np.testing.assert_array_equal(np.isnan(y), np.isnan(expected))
    assert not np.isfinite(np.asarray(y[1])).all()
    assert np.isfinite(np.asarray(y)[::2]).all()


def test_gradients_of_linear_layers_are_adjoint():
    # Where ReLU is open everywhere y is linear: <y, g> = <x, dx> = <k, dk>, and <b, db>
    # is what the bias contributes.
    images, kernel, _ = draw(3, (2, 9, 11, 32), (3, 2, 32, 64))
    bias = jnp.full(64, 1e3)
    value, *gradients = value_and_gradients(
        lambda *x: convolution.convolve_relu(*x, native=True),
        (images, kernel, bias),
        1,
    )
    places = jnp.arange(value.size, dtype=jnp.float32).reshape(value.shape)
    g = jnp.sin(17.0 * places)
    linear = reference(images, kernel, bias, 1) - bias[None, None, None]
    expected = float(jnp.sum(linear * g))
    for x, gradient in zip((images, kernel), gradients, strict=False):
        assert float(jnp.sum(x * gradient)) == pytest.approx(expected, rel=2e-3)
    np.testing.assert_allclose(gradients[2], jnp.sum(g, (0, 1, 2)), atol=1e-3)


def test_calls_at_the_same_time_do_not_disturb_each_other():
    arguments = draw(4, (16, 12, 12, 32), (3, 3, 32, 32))
    run = jax.jit(
        lambda *x: value_and_gradients(
            lambda *y: convolution.convolve_relu(*y, native=True), x, 1
        )
    )
    expected = [np.asarray(x) for x in run(*arguments)]
    with futures.ThreadPoolExecutor(6) as pool:
        for results in pool.map(lambda _: run(*arguments), range(60)):
            for result, known in zip(results, expected, strict=True):
                np.testing.assert_array_equal(result, known)


def test_rejects_an_image_without_batch():
    image, kernel, bias = draw(0, (9, 9, 2), (3, 3, 2, 4))
    with pytest.raises(AssertionError):
        convolution.convolve_relu(image, kernel, bias, 2)


def run_alone(text: str, *arguments: str) -> str:
    """Runs Python text in a process of its own and returns what it prints."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", text, *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


ONE_CORE = """
import os, sys
cores = sorted(os.sched_getaffinity(0))
os.sched_setaffinity(0, cores[:int(sys.argv[1])])
import jax, numpy as np, hashlib
from jaxil import native
from jaxil.maths import convolution
assert native.problem() is None
rng = np.random.default_rng(0)
x = [rng.normal(size=s).astype("f") for s in [(7, 12, 12, 32), (3, 3, 32, 32), (32,)]]
f = jax.jit(lambda *x: convolution.convolve_relu(*x, 1, native=True))
value, transpose = jax.vjp(f, *x)
print([hashlib.sha256(np.asarray(a)).hexdigest() for a in (value, *transpose(value))])
"""


def test_results_do_not_depend_on_the_number_of_threads():
    assert run_alone(ONE_CORE, "1") == run_alone(ONE_CORE, "8")


OTHER_PROCESSOR = """
import ctypes, pathlib, sys
import jax, numpy as np
from jaxil import native
from jaxil.maths import convolution
flags = [f for f in native.FLAGS if not f.startswith("-march")] + sys.argv[2:]
library = ctypes.CDLL(str(native.build(pathlib.Path(sys.argv[1]), tuple(flags))))
native.register(library)
rng = np.random.default_rng(0)
for stride, channels in ((1, 32), (2, 9)):
    shapes = [(3, 13, 17, channels), (3, 3, channels, 64), (64,)]
    x = [rng.normal(size=shape).astype("f") for shape in shapes]
    results = []
    for own in (True, False):
        f = lambda *x: convolution.convolve_relu(*x, stride, native=own)
        value, transpose = jax.jit(lambda *x: jax.vjp(f, *x))(*x)
        results.append((value, *transpose(np.sin(np.arange(value.size, dtype="f"))
                                          .reshape(value.shape))))
    for ours, theirs in zip(*results):
        np.testing.assert_allclose(ours, theirs, atol=1e-4 * np.abs(theirs).max())
print("equal")
"""


@pytest.mark.parametrize("kind", ["x86-64-v3", "x86-64-v4"])
def test_vectors_of_either_length_compute_the_same(kind, tmp_path):
    flags = pathlib.Path("/proc/cpuinfo").read_text()
    if {"x86-64-v3": " avx2 ", "x86-64-v4": " avx512vl "}[kind] not in flags:
        pytest.skip(f"this processor is no {kind}")
    assert run_alone(OTHER_PROCESSOR, str(tmp_path), f"-march={kind}") == "equal\n"
