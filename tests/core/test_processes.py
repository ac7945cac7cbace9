"""The rank of this process."""

from __future__ import annotations

import pytest

from gs2d.core.processes import ProcessRank, process_rank
from gs2d.errors import BackendError

SAID = {"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2"}
WHERE = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}


def test_the_rank_is_read_from_the_environment_of_torchrun() -> None:
    place = process_rank({**SAID, **WHERE})
    assert place == ProcessRank(3, 4, 1, 2)
    assert not place.leads
    assert process_rank({"RANK": "0", "WORLD_SIZE": "2", **WHERE}) == ProcessRank(0, 2, 0, 2)


@pytest.mark.parametrize("lacking", ["RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"])
def test_an_incomplete_environment_means_a_single_process(lacking: str) -> None:
    """Schedulers of clusters set some of these names too."""
    environment = {**SAID, **WHERE}
    del environment[lacking]
    assert process_rank(environment) == ProcessRank()
    assert ProcessRank().leads


@pytest.mark.parametrize(
    "wrong",
    [{"RANK": "4"}, {"RANK": "-1"}, {"WORLD_SIZE": "two"}, {"LOCAL_RANK": "2"}, {"LOCAL_WORLD_SIZE": "5"}],
)
def test_an_invalid_rank_is_one_line(wrong: dict[str, str]) -> None:
    with pytest.raises(BackendError, match="WORLD_SIZE"):
        process_rank({**SAID, **WHERE, **wrong})
