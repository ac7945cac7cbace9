"""Shape checks name the array, the dimension, and where the dimension came from."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.core.checks import check_shapes
from gs2d.errors import Gs2dError, ShapeError


def test_named_dimensions_are_returned() -> None:
    sizes = check_shapes({"means": (np.zeros((5, 3)), "N 3"), "sh": (np.zeros((5, 15, 3)), "N K 3")})
    assert sizes == {"N": 5, "K": 15}


def test_a_dimension_that_disagrees_is_named_with_its_origin() -> None:
    with pytest.raises(ShapeError, match=r"^quats must be \[N, 4\] with N=120 \(from means\), got \[119, 4\]$"):
        check_shapes({"means": (np.zeros((120, 3)), "N 3"), "quats": (np.zeros((119, 4)), "N 4")})


@pytest.mark.parametrize(
    ("shape", "pattern"), [((3,), "3 3"), ((3, 3, 1), "3 3"), ((3, 4), "3 3"), ((2, 3), "N N"), ((1,), "")]
)
def test_wrong_ranks_and_sizes_are_refused(shape: tuple[int, ...], pattern: str) -> None:
    with pytest.raises(ShapeError, match="x must be"):
        check_shapes({"x": (np.zeros(shape), pattern)})


def test_underscores_match_any_size_and_empty_patterns_are_scalars() -> None:
    assert check_shapes({"a": (np.zeros((7, 2)), "_ 2"), "b": (np.zeros((9, 2)), "_ 2"), "s": (np.zeros(()), "")}) == {}


def test_shape_errors_are_both_ours_and_value_errors() -> None:
    assert issubclass(ShapeError, Gs2dError)
    assert issubclass(ShapeError, ValueError)
