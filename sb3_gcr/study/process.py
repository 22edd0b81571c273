"""One cell in a process of its own: the request comes through stdin, which stays open as long as
the runner lives.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from typing import IO, Any


def read_request(stream: IO[str]) -> dict[str, Any]:
    """The request, one line; from then on the end of the stream ends this process.

    A runner that was killed cannot tell its cells, but the system closes its end of the pipe.

    :param stream: of the runner
    """
    request: dict[str, Any] = json.loads(stream.readline())
    threading.Thread(target=_exit_with_runner, args=(stream,), daemon=True).start()
    return request


def _exit_with_runner(stream: IO[str]) -> None:
    stream.read()
    os._exit(1)


def main() -> None:
    """Run the cell and write its result."""
    request = read_request(sys.stdin)
    from sb3_gcr.study.cells import run_cell
    from sb3_gcr.study.store import Store

    result = run_cell(request["cell"], request["threads"])
    Store(request["folder"]).write_result(result["id"], result)


if __name__ == "__main__":
    main()
