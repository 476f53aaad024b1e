"""Medians and quantiles, against those of NumPy."""

from __future__ import annotations

from djet_ros.core.medians import medians, medians_of_parts, quantile, weighted_median
from hypothesis import example, given, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

values = arrays(float, st.integers(1, 12), elements=st.floats(-10, 10))


@given(values, st.floats(0, 1))
@example(np.array([1.0, 2.0]), 1.0)
def test_a_quantile_is_that_of_numpy(values, share):
    before = values.copy()
    assert quantile(values, share) == pytest.approx(np.quantile(values, share), abs=1e-12)
    assert np.array_equal(values, before)


@given(arrays(float, st.tuples(st.integers(1, 4), st.integers(1, 9)),
              elements=st.floats(-10, 10)))
def test_medians_are_those_of_each_row(values):
    assert medians(values) == pytest.approx(np.median(values, axis=1), abs=1e-12)


@given(st.lists(values, min_size=1, max_size=4))
def test_medians_of_parts_are_those_of_each(parts):
    found = medians_of_parts(np.concatenate(parts), np.array([len(part) for part in parts]))
    assert found == pytest.approx([np.median(part) for part in parts], abs=1e-12)


def test_a_weighted_median_is_that_of_values_as_often_as_their_weights():
    rng = np.random.default_rng(0)
    for count in range(1, 12):
        values, often = rng.normal(size=count), 2 * rng.integers(1, 6, count)
        often[0] += 1  # so that one of them is in the middle
        assert weighted_median(values, often.astype(float)) == np.median(np.repeat(values, often))
