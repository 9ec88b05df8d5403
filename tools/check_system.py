"""Tell, before anything heavy starts, which system libraries Open3D needs and this machine lacks."""

import ctypes
import platform
import shutil
import sys

# library: packages of Debian/Ubuntu, Fedora, Arch
NEEDED = {
    "libGL.so.1": ("libgl1", "mesa-libGL", "libglvnd"),
    "libX11.so.6": ("libx11-6", "libX11", "libx11"),
    "libgomp.so.1": ("libgomp1", "libgomp", "gcc-libs"),
}
if platform.machine() == "aarch64":  # Open3D 0.20, the first with wheels there, links it
    NEEDED["libusb-1.0.so.0"] = ("libusb-1.0-0", "libusb1", "libusb")
INSTALLERS = (("apt-get", "sudo apt-get install -y"), ("dnf", "sudo dnf install -y"), ("pacman", "sudo pacman -S"))


def missing() -> list[str]:
    """Libraries that cannot be loaded."""
    absent = []
    for name in NEEDED:
        try:
            ctypes.CDLL(name)
        except OSError:
            absent.append(name)
    return absent


def main() -> int:
    """Name what is missing and the command that installs it; 2 if anything is."""
    if sys.platform != "linux":
        return 0
    absent = missing()
    if not absent:
        return 0
    column, command = 0, INSTALLERS[0][1]
    for k, (tool, line) in enumerate(INSTALLERS):
        if shutil.which(tool):
            column, command = k, line
            break
    packages = " ".join(NEEDED[name][column] for name in absent)
    print(f"setup: missing system libraries {', '.join(absent)}; run: {command} {packages}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
