"""Start a Ray cluster of several nodes on this machine; print its address and execute commands from stdin.

``lose`` kills the processes of all nodes with CPUs (or of the numbered nodes) and starts new nodes. The cluster stops
when stdin closes.
"""

from __future__ import annotations

import sys
from typing import Any

from ray.cluster_utils import Cluster

SMALL = {"object_store_memory": 80_000_000}
TRIES = 5  # attempts to start a node on a busy machine


def another_node(cluster: Cluster) -> Any:
    """Add a node to the cluster and return it; retries because Ray's timeout is short."""
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
