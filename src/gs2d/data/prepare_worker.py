"""A process that prepares photographs: pictures to make come pickled on its standard input, their sizes go out.

::

    python -m gs2d.data.prepare_worker

One line for each file that is done: its bytes; or ``error KIND TEXT``, and exit code 2.
"""

from __future__ import annotations

import os
import pickle
import sys

from gs2d.errors import DataError, DiskError


def main() -> int:
    """Prepare what is asked for."""
    import torch

    torch.set_num_threads(1)  # there are as many of these processes as there are cores for them
    for task in pickle.load(sys.stdin.buffer):  # from the process that started this one
        try:
            _tell(str(task.write()))
        except (DataError, DiskError) as error:
            _tell(f"error {type(error).__name__} {' '.join(str(error).split())}")
            return 2
        except BrokenPipeError:  # nobody wants it any more
            os._exit(1)
    return 0


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
