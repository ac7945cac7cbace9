"""The rank of this process."""

from __future__ import annotations

import pytest

from gs2d.core.processes import Place, here
from gs2d.errors import BackendError

SAID = {"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2"}
WHERE = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}


def test_the_rank_is_read_from_the_environment_of_torchrun() -> None:
    place = here({**SAID, **WHERE})
    assert place == Place(3, 4, 1, 2)
    assert not place.leads
    assert here({"RANK": "0", "WORLD_SIZE": "2", **WHERE}) == Place(0, 2, 0, 2)


@pytest.mark.parametrize("lacking", ["RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"])
def test_an_incomplete_environment_means_a_single_process(lacking: str) -> None:
    """Schedulers of clusters set some of these names too."""
    environment = {**SAID, **WHERE}
    del environment[lacking]
    assert here(environment) == Place()
    assert Place().leads


@pytest.mark.parametrize(
    "wrong",
    [{"RANK": "4"}, {"RANK": "-1"}, {"WORLD_SIZE": "two"}, {"LOCAL_RANK": "2"}, {"LOCAL_WORLD_SIZE": "5"}],
)
def test_an_invalid_rank_is_one_line(wrong: dict[str, str]) -> None:
    with pytest.raises(BackendError, match="WORLD_SIZE"):
        here({**SAID, **WHERE, **wrong})
