"""A Slurm cluster of this one machine, on the loopback, for as long as a ``with`` block lasts.

Needs root and Debian's packages ``slurmctld slurmd slurm-client munge``. Everything lies in one folder, but for
``/etc/slurm/slurm.conf``: the job steps read it there. A file that stood there is put back.
"""

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

CONFIG = Path("/etc/slurm/slurm.conf")
PROGRAMS = ["munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scancel", "sinfo"]
# memory is measured by Slurm itself, which kills a step that takes more than it has asked for: needs no cgroups
TEMPLATE = """\
ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller_port}
SlurmdPort={node_port}
SlurmUser=root
SlurmdUser=root
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill,UsePss
SlurmdParameters=config_overrides
MinJobAge=3600
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={memory_mb} State=UNKNOWN
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


def reason_to_skip() -> str:
    """Why this machine cannot play a cluster; "" if it can."""
    missing = [name for name in PROGRAMS if shutil.which(name, path=_path()) is None]
    if missing:
        return f"no {', '.join(missing)}: apt-get install slurmctld slurmd slurm-client munge"
    if os.geteuid() != 0:
        return "Slurm's daemons are started as root"
    if any(_is_running(name) for name in ("slurmctld", "slurmd")):
        return "this machine runs a Slurm of its own"
    return ""


@contextmanager
def one_node_slurm(folder: Path) -> Iterator[Path]:
    """Start munged, slurmctld and slurmd; the path of the controller's log. All are stopped at the end."""
    folder.mkdir(parents=True)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    with ExitStack() as stack:
        stack.enter_context(_configuration(folder))
        key = folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        stack.enter_context(
            _daemon(
                "munged", "--foreground", "--force", f"--key-file={key}", f"--socket={folder}/munge.socket",
                f"--log-file={folder}/munged.log", f"--pid-file={folder}/munged.pid",
                f"--seed-file={folder}/munge.seed", output=folder / "munged.out",
            )
        )  # fmt: skip
        _wait(lambda: (folder / "munge.socket").exists(), "munged", folder)
        stack.enter_context(_daemon("slurmctld", "-D", output=folder / "slurmctld.out"))
        stack.enter_context(_daemon("slurmd", "-D", output=folder / "slurmd.out"))
        stack.callback(_cancel_all, folder)
        _wait(lambda: _run("sinfo", "--noheader", "--format=%T").strip() == "idle", "the node", folder)
        yield folder / "slurmctld.log"


@contextmanager
def _configuration(folder: Path) -> Iterator[None]:
    host = socket.gethostname().split(".")[0]
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    text = TEMPLATE.format(
        host=host,
        folder=folder,
        controller_port=_free_port(),
        node_port=_free_port(),
        cpus=os.cpu_count(),
        memory_mb=int(pages / 2**20 * 0.95),
    )
    earlier = CONFIG.read_bytes() if CONFIG.exists() else None
    CONFIG.parent.mkdir(parents=True, exist_ok=True)
    CONFIG.write_text(text, encoding="utf-8")
    try:
        yield
    finally:
        if earlier is None:
            CONFIG.unlink()
        else:
            CONFIG.write_bytes(earlier)


@contextmanager
def _daemon(*command: str, output: Path) -> Iterator[None]:
    with output.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(
            command, stdout=stream, stderr=subprocess.STDOUT, env=os.environ | {"PATH": _path()}
        )
        try:
            yield
        finally:
            process.terminate()
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _cancel_all(folder: Path) -> None:
    _run("scancel", "--user=root")
    _wait(lambda: not _run("squeue", "--noheader", "--states=running,completing").strip(), "an end", folder)


def _wait(condition: Callable[[], bool], name: str, folder: Path, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            logs = "\n".join(f"== {path.name}\n{path.read_text()[-3000:]}" for path in folder.glob("*.[lo]*"))
            raise RuntimeError(f"Slurm: {name} is not ready after {seconds:.0f} s\n{logs}")
        time.sleep(0.5)


def _run(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True).stdout


def _path() -> str:
    return f"{os.environ['PATH']}{os.pathsep}/usr/sbin{os.pathsep}/sbin"


def _is_running(name: str) -> bool:
    names = (path.read_text().strip() for path in Path("/proc").glob("[0-9]*/comm") if path.exists())
    return name in names


def _free_port() -> int:
    with closing(socket.socket()) as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]
