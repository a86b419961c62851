"""Files that are replaced whole or not at all: a full disk, a kill or a second writer leaves the old one as it was."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path


def write_whole(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file at once: readers and later writers see the old content or the new, whatever happens in between.

    The content goes to a file without a name where the system has those (Linux), so that a process killed while it
    writes leaves nothing behind; elsewhere to a temporary file beside the target, removed on an exception.

    Args:
        path: of the file; a link is followed, and the permissions of a file that exists are kept.
        content: what it holds afterwards.

    Raises:
        OSError: the file cannot be written; the old one is untouched.
    """
    target = Path(os.path.realpath(path))
    try:
        if target.exists() and not target.is_file():
            raise OSError("it is no regular file")
        with _named(target, content) as temporary:
            os.replace(temporary, target)
        _sync_folder(target.parent)
    except OSError as error:
        raise type(error)(*error.args[:1], f"{os.fspath(path)!r} cannot be written: {error}") from error


@contextlib.contextmanager
def _named(target: Path, content: bytes) -> Iterator[Path]:
    """Yield a file beside the target with the content on disk; it is gone afterwards, by its new name or removed."""
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}.tmp")
    mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else None
    try:
        if not _make_nameless(temporary, content, mode):
            new = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            descriptor = os.open(temporary, new, 0o666)
            try:
                _fill(descriptor, content, mode)
            finally:
                os.close(descriptor)
        yield temporary
    finally:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()


def _make_nameless(name: Path, content: bytes, mode: int | None) -> bool:
    """Write a file that gets its name when its content is on disk; return False where the system has none."""
    if not hasattr(os, "O_TMPFILE"):
        return False
    try:
        descriptor = os.open(name.parent, os.O_TMPFILE | os.O_WRONLY, 0o666)
    except OSError:  # not on this file system
        return False
    try:
        _fill(descriptor, content, mode)
        folder = os.open(name.parent, os.O_RDONLY)
        try:  # with the descriptor of a folder, Python follows the link that /proc shows
            os.link(f"/proc/self/fd/{descriptor}", name.name, dst_dir_fd=folder, follow_symlinks=True)
        except (FileNotFoundError, NotImplementedError):  # without /proc
            return False
        finally:
            os.close(folder)
    finally:
        os.close(descriptor)
    return True


def _fill(descriptor: int, content: bytes, mode: int | None) -> None:
    with os.fdopen(descriptor, "wb", closefd=False) as file:
        file.write(content)
    if mode is not None and hasattr(os, "fchmod"):
        os.fchmod(descriptor, mode)
    os.fsync(descriptor)


def _sync_folder(folder: Path) -> None:
    """Put the new name itself on disk; what cannot be synchronised (Windows, some network drives) is left."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
