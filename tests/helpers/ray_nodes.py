"""A Ray cluster of several nodes on this machine, as a program: prints its address, and does what it reads.

``lose``: all nodes with CPUs lose their processes without grace, so that no task is spared, and others come. The end of
its input is its own end.
"""

from __future__ import annotations

import sys

from ray.cluster_utils import Cluster

SMALL = {"object_store_memory": 80_000_000}


def main() -> None:
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 0, "num_gpus": 0, "include_dashboard": False, **SMALL}
    )
    workers = [cluster.add_node(num_cpus=1, num_gpus=0, **SMALL) for _ in range(int(sys.argv[1]))]
    print(cluster.address, flush=True)
    for line in sys.stdin:
        if line.strip() == "lose":
            for node in workers:
                cluster.remove_node(node, allow_graceful=False)
            workers = [cluster.add_node(num_cpus=1, num_gpus=0, **SMALL) for _ in workers]
            print("lost", flush=True)
    cluster.shutdown()


if __name__ == "__main__":
    main()
