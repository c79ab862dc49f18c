"""Runs a command where vcan0 and vcan1 exist: in a network namespace of this kernel, or in User Mode Linux (UML).

`run` takes the namespace where this kernel has CAN and lets us create vcan interfaces; else it boots Debian's package
`user-mode-linux`, a Linux kernel that is an ordinary program (no root, no KVM), on the files of the host.
Either way this file is also the program that sets up and supervises inside: no insmod, mount or ip is needed.
Inside UML all files are read-only except below `cwd`; /run, /dev/shm and TMPDIR are memory and gone afterwards.
UML has one virtual CPU and gets one real one: it hands a system call to its kernel by waking another process, which
takes 23 us on the same CPU and 110 to 150 us on another that is asleep (measured on a virtual machine with two).
Sources: rtnetlink(7), unshare(2), finit_module(2), reboot(2); the kernel's Documentation/virt/uml and networking/can.
"""

import contextlib
import ctypes
import functools
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

THIS = str(Path(__file__).resolve())
INTERFACES, PACKAGES = ("vcan0", "vcan1"), ("user-mode-linux", "can-utils")
KERNEL, MODULES_AT = "usr/bin/linux.uml", "usr/lib/uml/modules/*/kernel"
# raid6 would measure its speed for 0.8 s of a 1.2 s boot; panic and noreboot: a kernel that fails ends at once.
BOOT = ("root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro", "con=null", "con0=null,fd:1", "quiet", "selinux=0",
        "panic=-1", "noreboot", "initcall_blacklist=raid6_select_algo")
# In loading order: can-raw, can-gw and can-bcm need can; vcan and vxcan need can-dev. sch_tbf: a queue that gets full.
MODULES = ("net/can/can", "drivers/net/can/dev/can-dev", "net/can/can-raw", "net/can/can-gw", "net/can/can-bcm",
           "drivers/net/can/vcan", "drivers/net/can/vxcan", "net/sched/sch_tbf")
MOUNTS = (("proc", "/proc"), ("sysfs", "/sys"), ("tmpfs", "/run"), ("tmpfs", "/dev/shm"), ("devpts", "/dev/pts"))
HIDDEN = ("/proc", "/sys", "/run", "/dev")  # what the host has there cannot be seen inside UML
FETCH_LIMIT_S = 100.0  # for all that comes from a package source; some 20 MB
BOOT_LIMIT_S = 60.0  # start and halt take 0.5 s on an idle machine; the rest is for a crowded one

CLONE_NEWUSER, CLONE_NEWNET, POWER_OFF, SYS_FINIT_MODULE = 0x10000000, 0x40000000, 0x4321FEDC, 313  # 313: x86-64
RTM_NEWLINK, RTM_DELLINK, NLM_REQUEST_ACK, NLM_CREATE = 16, 17, 0x5, 0x400  # rtnetlink(7), netlink(7)
IFLA_IFNAME, IFLA_LINKINFO, IFLA_INFO_KIND, IFF_UP = 3, 18, 1, 1


class VcanError(Exception):
    """The command could not be run with vcan; the message says why and what helps."""


class CommandTimeoutError(VcanError):
    """The command ran longer than it may; the message ends with what it had printed."""


class Job(NamedTuple):
    """What the host side hands to the inside, as JSON."""

    command: list[str]
    cwd: str
    timeout_s: float
    env: dict[str, str]
    modules: str


def fetch(cache: Path) -> Path:
    """Unpack (not install) `PACKAGES` into `cache`/root, once, and return that; several may ask at once.

    What could not be fetched is not tried again by this process.
    """
    root = cache.resolve() / "root"
    reason = _fetch(root)
    if reason:
        raise VcanError("User Mode Linux cannot be fetched; use a kernel that has vcan, or make a Debian package "
                        f"source reachable, or unpack the .deb files of {' and '.join(PACKAGES)} with dpkg -x into "
                        f"{root}: {reason}")
    if not (root / KERNEL).exists() or not list(root.glob(MODULES_AT)):
        raise VcanError(f"{root}: {KERNEL} or {MODULES_AT} is missing; delete the folder and try again")
    return root


@functools.cache
def _fetch(root: Path) -> str:
    """Make `root` unless it is there; why it cannot be made, "" when it is there."""
    import fcntl  # here, because this module is imported where there is none, too

    root.parent.mkdir(parents=True, exist_ok=True)
    with (root.parent / "lock").open("w") as lock, tempfile.TemporaryDirectory(dir=root.parent) as work:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not root.exists():
            try:
                _download(Path(work))
                for deb in Path(work).glob("*.deb"):
                    _tool(["dpkg", "-x", str(deb), f"{work}/root"], work, FETCH_LIMIT_S)
            except VcanError as error:
                return str(error)
            os.replace(f"{work}/root", root)
    return ""


def _download(folder: Path) -> None:
    """`apt-get download`; where the machine's package lists are missing or stale, again with fresh ones of our own."""
    limit = time.monotonic() + FETCH_LIMIT_S
    get = ["apt-get", "-q", "-o", "APT::Sandbox::User=root", "-o", "Acquire::Retries=1"]
    for scheme in ("http", "https"):
        get += ["-o", f"Acquire::{scheme}::Timeout=20"]
    try:
        _tool([*get, "download", *PACKAGES], folder, FETCH_LIMIT_S)
    except VcanError:
        get += ["-o", f"Dir::State::Lists={folder}/lists", "-o", f"Dir::Cache={folder}/apt"]
        (folder / "lists/partial").mkdir(parents=True)
        (folder / "apt/archives/partial").mkdir(parents=True)
        for words in (["update"], ["download", *PACKAGES]):
            _tool([*get, *words], folder, max(limit - time.monotonic(), 1.0))


def _tool(command: list[str], cwd: Path | str, limit_s: float) -> None:
    try:
        subprocess.run(command, cwd=cwd, input="", capture_output=True, text=True, check=True, timeout=limit_s)
    except (OSError, subprocess.SubprocessError) as error:
        told = " ".join(str(getattr(error, "stderr", None) or error).split())
        raise VcanError(f"{command[0]}: {told}") from error


def native_vcan_available() -> bool:
    """Whether this kernel gives a process of ours a network namespace of its own with vcan interfaces in it."""
    return subprocess.run([sys.executable, "-I", "-S", THIS, "probe", ""], capture_output=True).returncode == 0


def run(command: Sequence[str], cwd: Path, timeout_s: float, env: Mapping[str, str] | None = None, *, cache: Path,
        mem: str = "1G", native: bool | None = None) -> tuple[int, str]:
    """Run `command` with lo, vcan0 and vcan1 up and can-utils on PATH; `env` is added to this process's environment.

    Returns the exit code (negative: the signal that ended the command), and stdout and stderr in the order written.
    `cache`: see `fetch`. `mem`: what UML may use (only what it touches is taken). `native`: None decides by itself.
    """
    native = native_vcan_available() if native is None else native
    root = Path("/")
    if not native or shutil.which("candump") is None:
        try:
            root = fetch(cache)
        except VcanError:
            if not native:  # otherwise only can-utils are missing, which not every command needs
                raise
    cwd = cwd.resolve()
    for path in () if native else (cwd, root, Path(THIS), Path(sys.executable)):
        if any(path.is_relative_to(hidden) for hidden in HIDDEN) or " " in f"{THIS}{sys.executable}":
            raise VcanError(f"{path}: User Mode Linux has its own {', '.join(HIDDEN)}, and takes no space in paths of "
                            f"this module and of Python ({THIS}, {sys.executable}); move it")
    merged = {**os.environ, **({} if native else {"TMPDIR": "/run/tmp"}), **(env or {})}
    merged["PATH"] = f"{merged.get('PATH', os.defpath)}:{root}/usr/bin:/usr/sbin:/sbin"
    job = Job(list(command), str(cwd), timeout_s, merged, "" if native else str(next(root.glob(MODULES_AT))))
    with tempfile.TemporaryDirectory(prefix="uml", dir=None if native else "/tmp") as name:  # short: a socket's path
        folder = Path(name)
        (folder / "job").write_text(json.dumps(job._asdict()))
        start = [sys.executable, "-I", "-S", THIS, "native", name]
        if not native:
            start = [f"{root}/{KERNEL}", f"mem={mem}", f"umid={folder.name}", f"uml_dir={name}/", *BOOT,
                     f"init={sys.executable}", "--", "-I", "-S", THIS, "init", name]
        ended = _supervise(start, folder, timeout_s + BOOT_LIMIT_S, one_cpu=not native)
        output, status, console = (path.read_text(errors="replace") if path.exists() else ""
                                   for path in (folder / "output", folder / "status", folder / "console"))
    if status == "timeout":
        raise CommandTimeoutError(f"{job.command}: not done after {timeout_s} s; it printed:\n{output[-3000:]}")
    if not status:
        raise VcanError(f"{' '.join(start)}\n{ended} before {job.command} was done; console:\n{console[-3000:]}\n"
                        f"the command printed:\n{output[-3000:]}")
    return int(status), output


@contextlib.contextmanager
def _one_cpu() -> Iterator[None]:
    """What this thread starts meanwhile runs on one of its CPUs for good."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def _supervise(start: list[str], folder: Path, limit_s: float, *, one_cpu: bool) -> str:
    """Run `start` in a process group of its own that is gone when this returns, however that comes about."""
    with (folder / "console").open("wb") as console:
        with _one_cpu() if one_cpu else contextlib.nullcontext():
            process = subprocess.Popen(start, stdin=subprocess.DEVNULL, stdout=console, stderr=console, cwd=folder,
                                       env={"HOME": str(folder), "PATH": os.defpath}, start_new_session=True)
        try:
            return f"ended with exit code {process.wait(limit_s)}"
        except subprocess.TimeoutExpired:
            return f"was killed after {limit_s} s"
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def set_link(name: str, *, up: bool = True, create_kind: str = "") -> None:
    """Set interface `name` up or down, after creating it if `create_kind` says so (vcan); OSError where refused."""
    info = _attribute(IFLA_LINKINFO, _attribute(IFLA_INFO_KIND, create_kind.encode())) if create_kind else b""
    flags = NLM_REQUEST_ACK | (NLM_CREATE if create_kind else 0)
    _netlink(RTM_NEWLINK, flags, name, struct.pack("=BxHiII", 0, 0, 0, IFF_UP if up else 0, IFF_UP), info)


def delete_link(name: str) -> None:
    """Remove interface `name`; OSError where refused."""
    _netlink(RTM_DELLINK, NLM_REQUEST_ACK, name, bytes(16), b"")


def _attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def _netlink(request: int, flags: int, name: str, head: bytes, rest: bytes) -> None:
    body = head + _attribute(IFLA_IFNAME, name.encode() + b"\0") + rest
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.send(struct.pack("=IHHII", 16 + len(body), request, flags, 1, 0) + body)
        error = -struct.unpack_from("=i", netlink.recv(4096), 16)[0]
    if error:
        raise OSError(error, f"interface {name}: {os.strerror(error)}")


def _call(function: str, *arguments: object) -> None:
    """A function of libc that returns 0, or OSError."""
    if ctypes.CDLL(None, use_errno=True)[function](*arguments) != 0:
        raise OSError(ctypes.get_errno(), f"{function}{arguments}: {os.strerror(ctypes.get_errno())}")


def _interfaces() -> None:
    set_link("lo")
    for name in INTERFACES:
        set_link(name, create_kind="vcan")
    socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()  # OSError where can-raw is missing


def _namespace() -> None:
    """Move into a network namespace with the interfaces in it; without root, through a user namespace."""
    uid, gid = os.getuid(), os.getgid()
    _call("unshare", CLONE_NEWNET if uid == 0 else CLONE_NEWUSER | CLONE_NEWNET)
    for name, text in (("setgroups", "deny"), ("uid_map", f"0 {uid} 1"), ("gid_map", f"0 {gid} 1")) if uid else ():
        Path(f"/proc/self/{name}").write_text(text)
    _interfaces()


def _boot(job: Job, folder: Path) -> None:
    """What an init does: mounts, modules, interfaces."""
    assert os.getpid() == 1, "mode init mounts and halts: it is for process 1 of User Mode Linux only"
    for kind, target in (("hostfs", job.cwd), ("hostfs", str(folder)), *MOUNTS):
        os.makedirs(target, exist_ok=True)
        _call("mount", kind.encode(), target.encode(), kind.encode(), ctypes.c_ulong(0),
              target.encode() if kind == "hostfs" else None)
    os.symlink("/proc/self/fd", "/dev/fd")
    os.mkdir("/run/tmp", 0o1777)
    Path("/proc/sys/kernel/sched_rt_runtime_us").write_text("-1")  # else SCHED_FIFO may be held back, for 50 ms at once
    for module in MODULES:
        file = os.open(f"{job.modules}/{module}.ko", os.O_RDONLY)
        _call("syscall", ctypes.c_long(SYS_FINIT_MODULE), file, b"", 0)
    _interfaces()


def _execute(job: Job, folder: Path) -> None:
    """Run the command, its output in the file `output`; last of all `status` gets the exit code or "timeout"."""

    def alarm(_signal: int, _frame: object) -> NoReturn:
        raise TimeoutError

    with (folder / "output").open("wb") as output:
        signal.signal(signal.SIGALRM, alarm)
        signal.setitimer(signal.ITIMER_REAL, job.timeout_s)
        try:
            child = subprocess.Popen(job.command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                                     cwd=job.cwd, env=job.env)
            while child.returncode is None:
                pid, ended = os.wait()  # inside UML we are init: orphans come here too
                if pid == child.pid:
                    child.returncode = os.waitstatus_to_exitcode(ended)
            status = str(child.returncode)
        except TimeoutError:
            status = "timeout"
        except OSError as error:  # no such program: the shell's exit code
            output.write(f"{error}\n".encode())
            status = "127"
        signal.setitimer(signal.ITIMER_REAL, 0)
    (folder / "status").write_text(status)


def main(mode: str, folder: Path) -> None:
    """`probe`: exit 0 where the native way works; `native`, `init` (of UML): run the job in `folder`."""
    if mode == "probe":
        _namespace()
    else:
        job = Job(**json.loads((folder / "job").read_text()))
        _namespace() if mode == "native" else _boot(job, folder)
        _execute(job, folder)
        if mode == "init":
            os.sync()
            _call("reboot", ctypes.c_int(POWER_OFF))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))  # UML appends console=tty0 to the arguments of init
