"""The command `vcal` without its start: a process that has imported vcal forks for every command.

Importing takes most of the time of a small command, and a page has a dozen of them. What a command
is given (arguments, folder, environment, standard streams) comes through a socket, and its exit
code goes back.

Run as a program, with the path of the socket, it serves until its standard input ends.
"""

import atexit
import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path

_LONGEST = 1 << 20
"""Most bytes of the arguments, folder and environment of a command."""
_CLIENT = """\
#!{python} -SE
import json, os, socket, sys
with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
    server.connect({path!r})
    given = json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)]).encode()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, len(given) + 4096)
    socket.send_fds(server, [given], [0, 1, 2])
    sys.exit(int(server.recv(16) or b"70"))
"""


def client(environment: Mapping[str, str]) -> str | None:
    """A script that is `vcal` for processes with this environment, by a server that is started
    where there is none yet; None where processes do not fork.

    What is read on import, the variables of JAX, is that of the server.
    """
    if not hasattr(os, "fork") or not hasattr(socket, "SOCK_SEQPACKET"):
        return None
    kept = {name: value for name, value in environment.items() if name.startswith(("JAX_", "XLA_"))}
    key = json.dumps([kept, environment.get("PYTHONPATH")], sort_keys=True)
    if key not in _SERVERS:
        _SERVERS[key] = _start(environment)
    return _CLIENT.format(python=sys.executable, path=_SERVERS[key])


_SERVERS: dict[str, str] = {}
"""Paths of the sockets of the servers of this process."""


def _start(environment: Mapping[str, str]) -> str:
    folder = tempfile.TemporaryDirectory()  # its name is short, as that of a socket must be
    path = str(Path(folder.name) / "socket")
    server = subprocess.Popen(
        [sys.executable, __file__, path],
        env=dict(environment),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert server.stdin is not None and server.stdout is not None
    server.stdout.readline()  # it listens
    server.stdout.close()

    def end() -> None:
        assert server.stdin is not None
        server.stdin.close()
        server.wait()
        folder.cleanup()

    atexit.register(end)
    return path


def _serve(path: str) -> None:
    import vcal.__main__  # what every command imports
    import vcal.cli.commands  # noqa: F401

    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.bind(path)
        server.listen()
        print("listening", flush=True)
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the commands
        while True:
            ready, _, _ = select.select([server, sys.stdin], [], [])
            if server not in ready:
                return
            asked, _ = server.accept()
            with asked, warnings.catch_warnings():
                # JAX warns of forks because of its threads; there are none before it computes.
                warnings.simplefilter("ignore")
                if os.fork() == 0:
                    server.close()
                    _run(asked)


def _run(asked: socket.socket) -> None:
    """Run the command that a client asks for; the process ends."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    asked.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _LONGEST)
    given, streams, _, _ = socket.recv_fds(asked, _LONGEST, 3)
    for there, own in enumerate(streams):
        os.dup2(own, there)
        os.close(own)
    arguments, folder, environment = json.loads(given)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    warnings.resetwarnings()
    sys.argv = ["vcal", *arguments]
    code = 1
    try:
        vcal_main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        with contextlib.suppress(OSError):
            sys.stdout.flush()
        with contextlib.suppress(OSError):
            asked.send(str(code).encode())
        os._exit(code)


def vcal_main() -> None:
    """The entry point of the command `vcal`."""
    from vcal.__main__ import main

    main()


if __name__ == "__main__":
    _serve(sys.argv[1])
