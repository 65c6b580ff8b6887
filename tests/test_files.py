"""Files that appear whole or not at all: links, folders that cannot be written, and processes that are ended."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from waving import waving

import warp_yarn as wy
from warp_yarn.io import files


@pytest.mark.parametrize("write", [wy.write_usd, lambda path, trajectory: trajectory.save(path)], ids=["usd", "npz"])
def test_a_link_is_followed(tmp_path, write):
    """Also one to nothing yet, in another folder, and one to a link."""
    name = "a.usdc" if write is wy.write_usd else "a.npz"
    (tmp_path / "there").mkdir()
    os.symlink(tmp_path / "there" / name, tmp_path / name)
    os.symlink(tmp_path / name, tmp_path / f"second-{name}")
    for path in (tmp_path / name, tmp_path / f"second-{name}"):
        write(path, waving())
        assert path.is_symlink()
        assert os.listdir(tmp_path / "there") == [name] and not (tmp_path / "there" / name).is_symlink()
        (tmp_path / "there" / name).unlink()
    assert len(os.listdir(tmp_path)) == 3


def test_what_cannot_be_written_is_found_before(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(wy.InputError, match=r"the folder .* does not exist"):
        files.check_writable(tmp_path / "missing" / "a.npz")
    with pytest.raises(wy.InputError, match="is a folder, must be a file"):
        files.check_writable(tmp_path)
    with pytest.raises(wy.InputError, match="is a folder, must be a file"):
        waving().save(tmp_path)
    os.symlink(tmp_path / "missing" / "a.npz", tmp_path / "link.npz")
    with pytest.raises(wy.InputError, match=r"the folder .* does not exist"):
        waving().save(tmp_path / "link.npz")
    files.check_writable(tmp_path / "a.npz")
    assert sorted(os.listdir(tmp_path)) == ["file", "link.npz"]


def test_a_read_only_folder_is_found_before():
    """One of the system's, since root may write anywhere else."""
    if not Path("/proc/self").is_dir():
        pytest.skip("needs the files of a Linux")
    with pytest.raises(OSError, match=r"/proc/self/a\.npz: nothing can be written"):
        files.check_writable("/proc/self/a.npz")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows ends processes without a signal")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "SIGINT"])
def test_a_process_that_is_ended_leaves_nothing(tmp_path, number):
    code = (
        "import signal, sys, time\n"
        "from warp_yarn.io.files import atomic_write\n"
        # a shell's background jobs ignore it
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "with atomic_write(sys.argv[1]) as temporary:\n"
        "    temporary.write_text('half')\n"
        "    print('begun', flush=True)\n"
        "    time.sleep(60)\n"
    )
    arguments = [sys.executable, "-c", code, str(tmp_path / "a.txt")]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=tmp_path) as process:
        process.stdout.readline()
        assert len(os.listdir(tmp_path)) == 1
        begin = time.monotonic()
        process.send_signal(number)
        assert process.wait(30.0) != 0 and time.monotonic() - begin < 30.0
    assert os.listdir(tmp_path) == []
    assert number != signal.SIGTERM or process.returncode == 128 + number


def test_others_plans_for_sigterm_are_kept(tmp_path):
    if sys.platform == "win32":
        pytest.skip("Windows has no SIGTERM to send")
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with files.atomic_write(tmp_path / "a.txt") as temporary:
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
            temporary.write_text("whole")
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with files.atomic_write(tmp_path / "a.txt") as temporary:
            assert callable(signal.getsignal(signal.SIGTERM))
            temporary.write_text("again")
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)
    assert (tmp_path / "a.txt").read_text() == "again"


def test_what_a_write_raises_names_the_file(tmp_path):
    with pytest.raises(OSError, match=r"File too large: .*a\.npz"), files.atomic_write(tmp_path / "a.npz"):
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    assert os.listdir(tmp_path) == []
