"""Commands as forks of one process: ``python -IS forked.py SOCKET WORDS...`` is the command ``p2wss WORDS...``.

Snakemake starts a process for each job, and what p2wss imports takes longer than most jobs of a test. This program
hands its words, folder, environment and open files over to a process that has imported the libraries, of which a fork
then is the job. A signal reaches the program and not the fork.
"""

import json
import os
import socket
import sys


def run(path: str, words: list[str]) -> int:
    """The exit status of the command."""
    names = os.listdir("/dev/fd")
    # all but that of the folder itself, which is closed by now
    descriptors = [int(name) for name in names if os.path.exists(f"/dev/fd/{name}")]
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(path)
    job = {"words": words, "folder": os.getcwd(), "environment": dict(os.environ), "descriptors": descriptors}
    socket.send_fds(connection, [b"."], descriptors)
    connection.sendall(json.dumps(job).encode())
    connection.shutdown(socket.SHUT_WR)
    return int(connection.recv(4) or b"70")


def serve(path: str) -> None:
    """Run what each connection asks for, until this process is ended or the one that started it is gone."""
    import signal

    listener = socket.socket(socket.AF_UNIX)
    listener.bind(path)
    listener.listen()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the forks
    listener.settimeout(2)
    parent = os.getppid()
    while os.getppid() == parent:
        try:
            connection, _ = listener.accept()
        except TimeoutError:
            continue
        if not os.fork():
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            listener.close()
            status = 70
            try:
                status = _run(connection)
            finally:
                connection.sendall(str(status).encode())
                os._exit(status)
        connection.close()


def _run(connection: socket.socket) -> int:
    import atexit
    import traceback

    received = socket.recv_fds(connection, 1, 64)[1]
    text = b"".join(iter(lambda: connection.recv(1 << 16), b""))
    job = json.loads(text)
    # apart from the numbers that the command expects
    received = [_far(each) for each in received]
    for each, descriptor in zip(received, job["descriptors"], strict=True):
        os.dup2(each, descriptor)
        os.close(each)
    os.chdir(job["folder"])
    os.environ.clear()
    os.environ.update(job["environment"])
    sys.path[:0] = os.environ["PYTHONPATH"].split(os.pathsep)
    sys.argv = ["p2wss", *job["words"]]
    try:
        from p2wss.cli import main

        status = main()
    except SystemExit as end:
        status = end.code
    except BaseException:
        traceback.print_exc()
        status = 1
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    return int(status or 0)


def _far(descriptor: int) -> int:
    import fcntl

    far = fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 500)
    os.close(descriptor)
    return far


if __name__ == "__main__":
    raise SystemExit(run(sys.argv[1], sys.argv[2:]))
