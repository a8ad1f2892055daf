"""A virtual machine that runs one command on a kernel with drivers of our choice, and brings back what it wrote."""

from __future__ import annotations

import os
import shlex
import shutil
import stat
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.contract.guest.kernel import GuestUnavailableError, Kernel, fetch_kernel, read_module
from tests.npm import lacking

__all__ = ["FILES", "Finished", "GuestError", "GuestUnavailableError", "Module", "require_guest", "run_in_guest"]

HOST_TAG = "host"
SHARE_TAG = "share"
SHARE = "/run/guest"
"""Where the guest sees the folder that it shares with the host."""
FAULT = "guest fault:"
"""Begins the line that the guest writes to its console when it cannot come up."""

QEMU = "qemu-system-x86_64"
FILES = f"{SHARE}/files"
"""The folder, as the guest sees it, whose files come back."""

# Mitigations cost an emulated processor time and protect nobody; its clock is the host's, whatever the kernel fears.
_KERNEL_ARGUMENTS = "console=ttyS0 quiet loglevel=4 panic=-1 mitigations=off nokaslr tsc=reliable random.trust_cpu=on"
_CHECKOUT = Path(__file__).resolve().parents[3]


class GuestError(Exception):
    """The guest did not come up, or did not finish in time. The message holds the end of its console and output."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A command that ended in the guest.

    output : its standard output and error. files : a folder with what it wrote to `FILES`. total_s : with the boot.
    """

    exit_code: int
    output: str
    files: Path
    total_s: float


def run_in_guest(
    command: Sequence[str],
    *,
    folder: Path,
    modules: Sequence[Module] = (),
    devices: Sequence[str] = (),
    timeout_s: float = 300.0,
    monitor: bool = False,
) -> Finished:
    """Boot, run one command in the checkout, power off.

    command : runs as root, sees /dev and /sys of the guest, has a loopback interface only, and may write anywhere: all
    but the files in `FILES` is forgotten. folder : an empty one. modules : loaded before, with what they depend on.
    devices : QEMU's `-device` arguments. timeout_s : the machine is killed then, and with this process in any case.
    monitor : whether the guest's second serial port is QEMU's own monitor (QMP), which shows what its displays show.

    Raises GuestUnavailableError: QEMU or Debian's kernel cannot be had here; GuestError: it did not come up or finish.
    """
    qemu, kernel = _qemu(), fetch_kernel()
    archive, console, share = folder / "initrd", folder / "console", folder / "share"
    (share / "files").mkdir(parents=True)
    archive.write_bytes(initrd(kernel, modules))
    (share / "command").write_text(_script(command))
    arguments = [
        # A guard below this process: the machine ends even if this process is killed.
        *("timeout", "--kill-after=5", f"{timeout_s + 10:.0f}"),
        *(qemu, "-nodefaults", "-no-user-config", "-display", "none", "-no-reboot", "-nic", "none"),
        *("-machine", "q35", "-accel", "tcg,thread=multi", "-cpu", "max,la57=off"),
        *("-smp", "2", "-m", "1536", "-serial", f"file:{console}"),
        *("-kernel", str(kernel.image), "-initrd", str(archive), "-append", _KERNEL_ARGUMENTS),
        *("-virtfs", f"local,path=/,mount_tag={HOST_TAG},security_model=none,readonly=on,multidevs=remap"),
        *("-virtfs", f"local,path={_escaped(share)},mount_tag={SHARE_TAG},security_model=none"),
        *("-device", "virtio-rng-pci"),
        *(word for device in devices for word in ("-device", device)),
        *(_monitor(folder / "monitor") if monitor else ()),
    ]
    begun = time.monotonic()
    said, timed_out = _run(arguments, timeout_s)
    total_s = time.monotonic() - begun
    output = _text(share / "output")
    exit_code = share / "exit_code"
    fault = next((line for line in _text(console).splitlines() if FAULT in line), None)
    if timed_out or fault is not None or not exit_code.is_file():
        how = f"did not finish in {timeout_s:.0f} s" if timed_out else fault or "went down before its command ended"
        message = (
            f"the guest {how} (it ran {total_s:.0f} s)\nQEMU: {said.strip()[-500:]}\n"
            f"console: {_text(console)[-2000:]}\noutput: {output[-3000:]}"
        )
        raise GuestError(message)
    return Finished(int(exit_code.read_text()), output, share / "files", total_s)


def require_guest() -> None:
    """Skip where the guest is not to be had; fail instead in CI (CI=true), unless apt cannot fetch a kernel."""
    try:
        _qemu()
        fetch_kernel()
    except GuestUnavailableError as error:
        if error.fixable:
            lacking(f"no guest: {error}")
        pytest.skip(f"no guest: {error}")


def _monitor(socket: Path) -> Sequence[str]:
    """The machine listens as a monitor, and its serial port calls there."""
    path = _escaped(socket)
    return (
        *("-chardev", f"socket,id=monitor,path={path},server=on,wait=off", "-mon", "chardev=monitor,mode=control"),
        *("-chardev", f"socket,id=port,path={path}", "-serial", "chardev:port"),
    )


def _qemu() -> str:
    found = shutil.which(QEMU)
    if found is None:
        message = f"{QEMU} is not installed; run: apt-get install --no-install-recommends qemu-system-x86"
        raise GuestUnavailableError(message, fixable=True)
    return found


def _script(command: Sequence[str]) -> str:
    variables = {
        "HOME": "/root",
        "LANG": "C.UTF-8",
        "PATH": f"{Path(sys.executable).parent}:{os.environ.get('PATH', os.defpath)}",
        "PYTHONUNBUFFERED": "1",
        # Threads that wait by spinning are emulated, too.
        "OPENBLAS_NUM_THREADS": "1",
        # The processor's own instructions for SHA-256, emulated, are nine times as slow as OpenSSL's plain code.
        "OPENSSL_ia32cap": "0:0",
    }
    given = " ".join(shlex.quote(f"{name}={value}") for name, value in variables.items())
    return f"cd {shlex.quote(str(_CHECKOUT))} && exec env -i {given} {shlex.join(command)}\n"


def _run(arguments: Sequence[str], timeout_s: float) -> tuple[str, bool]:
    """What the machine's program said, and whether it had to be killed."""
    machine = subprocess.Popen(  # noqa: S603 - our own words
        arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        return machine.communicate(timeout=timeout_s)[0], False
    except subprocess.TimeoutExpired:
        return _killed(machine), True
    except BaseException:
        _killed(machine)
        raise


def _killed(machine: subprocess.Popen[str]) -> str:
    # The guard passes the signal on, waits for QEMU, and kills it if it lingers.
    machine.terminate()
    return machine.communicate(timeout=30)[0]


def _escaped(path: Path) -> str:
    return str(path).replace(",", ",,")


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.is_file() else ""


_TRANSPORT = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "virtio_rng")

# The host's root lies below a file system in memory: the guest sees the same programs, and writes to nothing but SHARE.
_INIT = f"""#!/bin/busybox sh
/bin/busybox --install -s /bin
fault() {{ echo "{FAULT} $*"; poweroff -f; }}
mount -t proc proc /proc && mount -t sysfs sys /sys && mount -t devtmpfs dev /dev || fault "no /proc, /sys, /dev"
while read -r file parameters; do
  insmod "/modules/$file" $parameters || fault "module $file $parameters could not be loaded"
done < /modules/list
mkdir -p /lower /memory /root
mount -t 9p -o trans=virtio,version=9p2000.L,ro,msize=512000,cache=loose {HOST_TAG} /lower || fault "no host files"
mount -t tmpfs memory /memory && mkdir /memory/upper /memory/work
mount -t overlay -o lowerdir=/lower,upperdir=/memory/upper,workdir=/memory/work root /root || fault "no overlay"
for folder in proc sys dev; do mkdir -p "/root/$folder"; mount --move "/$folder" "/root/$folder"; done
mkdir -p /root/dev/pts /root/dev/shm /root/run
mount -t devpts pts /root/dev/pts; mount -t tmpfs shm /root/dev/shm; mount -t tmpfs run /root/run
ifconfig lo 127.0.0.1 up
mkdir -p /root{SHARE}
mount -t 9p -o trans=virtio,version=9p2000.L,rw,msize=512000 {SHARE_TAG} /root{SHARE} || fault "no shared folder"
chroot /root /bin/sh {SHARE}/command > /root{SHARE}/output 2>&1
echo $? > /root{SHARE}/exit_code
sync
poweroff -f
"""


@dataclass(frozen=True, slots=True)
class Module:
    """A kernel module to load in the guest, and its parameters (`n_devs=2 node_types=0x1,0x1`)."""

    name: str
    parameters: str = ""


def initrd(kernel: Kernel, modules: Sequence[Module]) -> bytes:
    """The archive to boot with: loads the modules in order, mounts the host, runs SHARE/command, powers off.
    Raises LookupError: the kernel has no such module.
    """
    parameters = {module.name.replace("-", "_"): module.parameters for module in modules}
    files = kernel.module_files([*_TRANSPORT, *(module.name for module in modules)])
    lines: list[str] = []
    folder = (stat.S_IFDIR | 0o755, b"")
    entries = dict.fromkeys(("bin", "dev", "modules", "proc", "sys"), folder)
    for path in files:
        name = path.name.split(".", 1)[0]
        lines.append(f"{name}.ko {parameters.get(name.replace('-', '_'), '')}".strip())
        entries[f"modules/{name}.ko"] = (stat.S_IFREG | 0o644, read_module(path))
    entries["modules/list"] = (stat.S_IFREG | 0o644, "".join(f"{line}\n" for line in lines).encode())
    entries["bin/busybox"] = (stat.S_IFREG | 0o755, kernel.busybox.read_bytes())
    entries["init"] = (stat.S_IFREG | 0o755, _INIT.encode())
    return archive(entries)


def archive(entries: Mapping[str, tuple[int, bytes]]) -> bytes:
    """A cpio archive in the kernel's format "newc" (kernel documentation, "initramfs buffer format").
    entries : mode (type and permissions) and content by path, folders before what lies in them.
    """
    parts: list[bytes] = []
    for number, (name, (mode, content)) in enumerate([*entries.items(), ("TRAILER!!!", (0, b""))], start=1):
        fields = (number, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
        header = b"070701" + b"".join(b"%08X" % value for value in fields)
        parts += [_padded(header + name.encode() + b"\0"), _padded(content)]
    return b"".join(parts)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)
