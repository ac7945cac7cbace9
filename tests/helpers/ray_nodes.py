"""Start a Ray cluster of several nodes on this machine: prints its address and executes commands from stdin.

``lose`` kills the processes of all nodes with CPUs (or of the numbered ones) and starts new nodes. The cluster ends
with its input.
"""

from __future__ import annotations

import sys
from typing import Any

from ray.cluster_utils import Cluster

SMALL = {"object_store_memory": 80_000_000}
TRIES = 5  # of a node to come, on a machine with other work


def another_node(cluster: Cluster) -> Any:
    """Return a node that has come to the cluster; Ray gives up waiting for it early."""
    for left in reversed(range(TRIES)):
        try:
            return cluster.add_node(num_cpus=1, num_gpus=0, **SMALL)
        except Exception:
            if not left:
                raise
    raise AssertionError


def main() -> None:
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 0, "num_gpus": 0, "include_dashboard": False, **SMALL}
    )
    workers = [another_node(cluster) for _ in range(int(sys.argv[1]))]
    print(cluster.address, flush=True)
    for line in sys.stdin:
        word, *which = line.split()
        if word == "lose":
            lost = [int(number) for number in which] or range(len(workers))
            for number in lost:
                cluster.remove_node(workers[number], allow_graceful=False)
            for number in lost:
                workers[number] = another_node(cluster)
            print("lost", flush=True)
    cluster.shutdown()


if __name__ == "__main__":
    main()
