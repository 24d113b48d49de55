"""Finds the packages, and builds distributions that depend on nothing but their content.

The folders at the top level are rooms of one import package, ``filtergym``. Two checkouts of one commit give the same bytes,
whatever their file dates, the user's umask and the order of the file system.
"""

import gzip
import os
import tarfile
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOMS = ("compiler", "filters", "envs", "evaluation", "baselines", "agents")
FRONT = find_packages("filtergym", exclude=("papers", "papers.*", *ROOMS, *(f"{room}.*" for room in ROOMS)))
"""What is found in the folder ``filtergym`` itself: the rooms are links there, and papers are not installed."""
DATE = int(
    os.environ.setdefault("SOURCE_DATE_EPOCH", "1767225600")
)  # 1 January 2026; the wheel reads it, too
os.umask(0o022)  # a wheel keeps the permissions of what is written here


class ReproducibleBuild(build_py):
    """Files of the wheel, with permissions that are not those of the checkout."""

    def copy_file(self, infile, outfile, preserve_mode=True, *more, **named):  # type: ignore[no-untyped-def]
        """Copy a file, but not its permissions."""
        return super().copy_file(infile, outfile, False, *more, **named)


def without_machine(member: tarfile.TarInfo) -> tarfile.TarInfo:
    """Take from an archive's member what belongs to the machine that builds it: date, owner, permissions of others."""
    member.mtime, member.uid, member.gid, member.uname, member.gname = DATE, 0, 0, "", ""
    member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
    return member


class ReproducibleSource(sdist):
    """The source distribution, with the same bytes from every checkout of a commit."""

    def make_archive(self, base_name, format, root_dir=None, base_dir=None, owner=None, group=None):  # type: ignore[no-untyped-def]
        """Write the folder ``base_dir`` as ``base_name.tar.gz`` and return that name; other formats as ever."""
        if format != "gztar":
            return super().make_archive(base_name, format, root_dir, base_dir, owner, group)
        path = f"{base_name}.tar.gz"
        files = sorted(file for file in Path(base_dir).rglob("*") if not file.is_dir())
        with (
            open(path, "wb") as raw,
            gzip.GzipFile("", "wb", fileobj=raw, mtime=DATE) as packed,
            tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive,
        ):
            for file in files:
                archive.add(file, file.as_posix(), recursive=False, filter=without_machine)
        return path


setup(
    cmdclass={"build_py": ReproducibleBuild, "sdist": ReproducibleSource},
    packages=[
        *("filtergym", *(f"filtergym.{name}" for name in FRONT)),
        *(f"filtergym.{room}" for room in ROOMS),
        *(f"filtergym.{room}.{name}" for room in ROOMS for name in find_packages(room)),
    ],
)
