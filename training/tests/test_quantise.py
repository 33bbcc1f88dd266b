"""Rounding to four bits: the contents of the file, and the weight of errors by the inputs."""

import sys
from pathlib import Path

import pytest

gguf = pytest.importorskip("gguf", reason="training/requirements.txt is not installed")
np = pytest.importorskip("numpy", reason="training/requirements.txt is not installed")

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import quantise


def error(matrix, other, inputs):
    return float((((matrix - other) @ inputs.T) ** 2).sum())


def test_a_rounded_matrix_is_read_from_its_bytes_and_errs_less_on_its_inputs_than_plain_rounding():
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(48, 96)).astype(np.float32)
    matrix[3, :32] = 0
    # A few directions carry most of the inputs, as in a trained model.
    inputs = (rng.normal(size=(2000, 12)) @ rng.normal(size=(12, 96)) + 0.3 * rng.normal(size=(2000, 96))).astype(np.float32)
    held, packed = quantise.rounded(matrix, inputs.T @ inputs)
    read = gguf.quants.dequantize(packed, quantise.KIND).reshape(matrix.shape)
    assert np.array_equal(read, held) and not held[3, :32].any()
    plain, _ = quantise.rounded(matrix, np.eye(96, dtype=np.float32))
    assert error(matrix, held, inputs) < 0.5 * error(matrix, plain, inputs)
    assert np.abs(plain - matrix).max() < 0.2 * np.abs(matrix).max()
