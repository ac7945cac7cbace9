"""What a machine of a cluster is sent: a function that does one task there, if it can.

It is sent by value, so that it runs where gs2d is missing or another one, too, and says so. Hence no import of gs2d at
the top, and no name of this module's that is not in ``do_on_worker``.
"""

from __future__ import annotations

from typing import Any


def do_on_worker(order: dict[str, Any], queue: Any) -> dict[str, Any]:
    """Do a task in this process of a cluster.

    Parameters
    ----------
    order : dict
        ``name``; ``task``, pickled; ``version`` of the driver; ``folder``, ``token`` of its list;
        ``cwd``, where paths begin.
    queue : ray.util.queue.Queue
        Takes (name, event).

    Returns
    -------
    dict
        ``state`` as in the record of the task, with its ``reason``; or ``refused``, and why: nothing can be done here.
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
    with contextlib.suppress(OSError):  # whole paths need none
        os.chdir(order["cwd"])
    from gs2d.contrib.lab.cluster_task import do_order

    return do_order(order, queue, here)
