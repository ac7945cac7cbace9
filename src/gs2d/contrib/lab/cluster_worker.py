"""The function that runs a task on a machine of a cluster.

It is sent by value, so that it can report a missing or different gs2d. Therefore the module does not import gs2d at the
top, and ``do_on_worker`` uses no other name of the module.
"""

from __future__ import annotations

from typing import Any


def do_on_worker(order: dict[str, Any], queue: Any) -> dict[str, Any]:
    """Run a task in this process of a cluster.

    ``order`` has ``name``; ``task``, pickled; ``version`` of the driver; ``folder``, ``token`` of the output; ``cwd``,
    the base of relative paths. ``queue`` (ray.util.queue.Queue) takes (name, event). Returns the ``state`` of the
    task's record, with its ``reason``; or "refused" with a reason if no task can run here.
    """
    import contextlib
    import os
    import socket

    here = socket.gethostname()
    try:
        import gs2d
    except ImportError as error:
        return {"state": "refused", "reason": f"{here} of the cluster cannot import gs2d ({error}); install it there"}
    if gs2d.__version__ != order["version"]:
        return {
            "state": "refused",
            "reason": f"{here} of the cluster has gs2d {gs2d.__version__}, this command {order['version']}; "
            "install the same version on all machines",
        }
    with contextlib.suppress(OSError):  # absolute paths do not depend on it
        os.chdir(order["cwd"])
    from gs2d.contrib.lab.cluster_task import do_order

    return do_order(order, queue, here)
