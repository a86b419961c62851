"""Files that are damaged, forged or cut short are refused in words; a save that fails leaves the old file as it was."""

import errno
import json
import os
import pickle
import random
import resource
import signal
import struct
import sys
import threading

import pytest
import torch

import torch_dpc as dpc
from helpers import small_layer
from torch_dpc import files

safetensors = pytest.importorskip("safetensors.torch", reason="saving needs safetensors")

FLIPS = 1000
LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="files without a name are Linux's")


@pytest.fixture
def path(tmp_path):
    """A saved layer."""
    small_layer(u_set=dpc.Ball(0.4)).save(tmp_path / "layer")
    return tmp_path / "layer"


def refused(path, says="damaged|not a whole|not one that|version|is not known"):
    with pytest.raises(ValueError, match=says):
        dpc.DPCLayer.load(path)


def only(path):
    """Whether the file stands alone in its folder."""
    return [p.name for p in path.parent.iterdir()] == [path.name]


# --- damage -----------------------------------------------------------------------------------------------------------


def test_a_file_cut_at_any_percent_is_refused(path):
    whole = path.read_bytes()
    for percent in range(100):
        path.write_bytes(whole[: len(whole) * percent // 100])
        refused(path)


def test_every_flipped_bit_is_seen(path):
    whole = path.read_bytes()
    source = random.Random(0)
    header = 8 + struct.unpack("<Q", whole[:8])[0]
    bits = [source.randrange(8 * header) for _ in range(FLIPS // 2)]  # half of them in the header, which is smaller
    bits += [source.randrange(8 * header, 8 * len(whole)) for _ in range(FLIPS - len(bits))]
    for bit in bits:
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        refused(path)


def test_a_file_of_an_earlier_version_has_no_checksum_and_loads(path):
    layer = dpc.DPCLayer.load(path)
    with safetensors.safe_open(path, framework="pt") as file:
        text = json.loads(file.metadata()["torch_dpc"])
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    assert len(text.pop("sha256")) == 64
    safetensors.save_file(tensors, path, metadata={"torch_dpc": json.dumps(text)})
    assert torch.equal(dpc.DPCLayer.load(path).data.Up, layer.data.Up)


# --- forgery ----------------------------------------------------------------------------------------------------------


def forged(entries, payload=b"", length=None):
    header = json.dumps(entries).encode()
    return struct.pack("<Q", len(header) if length is None else length) + header + payload


TENSOR = {"dtype": "F64", "shape": [2], "data_offsets": [0, 16]}
META = {"torch_dpc": "{}"}


@pytest.mark.parametrize(
    "content",
    [
        forged({"x": TENSOR}, bytes(16), length=2**63),
        forged({"x": TENSOR}, bytes(16), length=2**64 - 1),
        forged({"x": TENSOR}, bytes(16), length=10**6),
        forged({"x": TENSOR}, bytes(16), length=3),
        forged({"x": {**TENSOR, "shape": [2**62, 4]}}, bytes(16)),
        forged({"x": {**TENSOR, "shape": [-1]}}, bytes(16)),
        forged({"x": {**TENSOR, "data_offsets": [0, 1 << 40]}}, bytes(16)),
        forged({"x": {**TENSOR, "data_offsets": [16, 0]}}, bytes(16)),
        forged({"x": TENSOR, "y": TENSOR}, bytes(16)),
        forged({"x": {**TENSOR, "dtype": "PICKLE"}}, bytes(16)),
        forged({"x": TENSOR}, bytes(64)),
        forged({"__metadata__": META, "x": TENSOR}, bytes(16)),
        forged({"__metadata__": {"torch_dpc": "[" * 100_000}, "x": TENSOR}, bytes(16)),
        forged({"__metadata__": {"torch_dpc": "3"}, "x": TENSOR}, bytes(16)),
    ],
)
def test_headers_that_lie(path, content):
    path.write_bytes(content)
    refused(path, "damaged|not a whole|not one that|version")


def edited(path, change):
    """Forge a file whose checksum is right: what only the checks of the values can refuse."""
    from torch_dpc.saving import _checksum

    with safetensors.safe_open(path, framework="pt") as file:
        text = json.loads(file.metadata()["torch_dpc"])
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    del text["sha256"]
    change(text, tensors)
    text["sha256"] = _checksum(text, tensors)
    safetensors.save_file(tensors, path, metadata={"torch_dpc": json.dumps(text)})


def nested(depth):
    tree = []
    for _ in range(depth):
        tree = [tree]
    return tree


@pytest.mark.parametrize(
    "change",
    [
        lambda text, tensors: text["data"].update(t_ini=-3),
        lambda text, tensors: text["data"].update(t_ini="3"),
        lambda text, tensors: text["data"].update(horizon=10**12),
        lambda text, tensors: text["data"].update(n_u=0),
        lambda text, tensors: text["data"].update(recorded_as=7),
        lambda text, tensors: text["data"]["row_space"].update(rank=10**9),
        lambda text, tensors: text["arguments"].update(Q={"tensor": "nowhere"}),
        lambda text, tensors: text["arguments"].update(Q={"tensor": ["a"], "parameter": True, "requires_grad": True}),
        lambda text, tensors: text["arguments"].update(Q={"number": "nan"}),
        lambda text, tensors: text["arguments"].update(Q={"number": "a lot"}),
        lambda text, tensors: text["arguments"].update(u_set={"set": "os.system", "arguments": {"x": 1}}),
        lambda text, tensors: text["arguments"].update(u_set={"set": "ConvexSet", "arguments": {}}),
        lambda text, tensors: text["arguments"].update(u_set={"set": ["Box"], "arguments": {}}),
        lambda text, tensors: text["arguments"].update(u_set=nested(900)),
        lambda text, tensors: text.update(arguments=3),
        lambda text, tensors: text.update(more=3),
        lambda text, tensors: tensors["data.Yf"].__setitem__((0, 0), float("nan")),
        lambda text, tensors: tensors.update({"data.Up": tensors["data.Up"].to(torch.int64)}),
    ],
)
def test_contents_that_lie(path, change):
    edited(path, change)
    with pytest.raises(ValueError):
        dpc.DPCLayer.load(path)


class Payload:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return (open, (self.marker, "w"))


def test_a_pickle_in_disguise_runs_nothing(path, tmp_path):
    marker = tmp_path / "ran"
    path.write_bytes(pickle.dumps(Payload(str(marker))))
    refused(path, "not a whole safetensors file")
    torch.save({"x": Payload(str(marker))}, path)
    refused(path, "not a whole safetensors file")
    assert not marker.exists()


# --- writing ----------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["without a name", "temporary"])
def kind(request, monkeypatch):
    """Both ways of writing: Linux's files without a name, and temporary files elsewhere."""
    if request.param == "temporary":
        monkeypatch.delattr(os, "O_TMPFILE", raising=False)
    elif not hasattr(os, "O_TMPFILE"):
        pytest.skip("this system has no files without a name")


def test_a_full_disk_leaves_the_old_file(path, kind):
    """A limit on the size of files stands for a disk that fills while the file is written."""
    before, limits = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    layer = small_layer()
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))
    try:
        with pytest.raises(OSError, match="cannot be written") as error:
            layer.save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert error.value.errno == errno.EFBIG
    assert path.read_bytes() == before and only(path)


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_at_any_step_leaves_the_old_file(path, kind, step, failure, monkeypatch):
    before = path.read_bytes()

    def fails(*_, **__):
        raise failure

    monkeypatch.setattr(os, step, fails)
    with pytest.raises(type(failure)):
        small_layer().save(path)
    monkeypatch.undo()
    assert path.read_bytes() == before and only(path)


@LINUX
def test_a_kill_while_writing_leaves_nothing(path):
    """The process dies with all of the content written, before the file has a name."""
    before, layer = path.read_bytes(), small_layer()
    child = os.fork()
    if child == 0:
        os.fsync = lambda descriptor: os.kill(os.getpid(), signal.SIGKILL)
        layer.save(path)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert path.read_bytes() == before and only(path)


def test_two_writers_and_a_reader(path, kind):
    """Whoever is last wins; a reader never sees half a file."""
    layers = [small_layer(lambda_g=value) for value in (1.0, 2.0)]
    errors = []

    def write(layer):
        try:
            for _ in range(20):
                layer.save(path)
        except Exception as error:  # noqa: BLE001
            errors.append(error)

    threads = [threading.Thread(target=write, args=(layer,)) for layer in layers]
    for thread in threads:
        thread.start()
    seen = set()
    while any(thread.is_alive() for thread in threads):
        seen.add(dpc.DPCLayer.load(path).lambda_g)
    assert not errors and dpc.DPCLayer.load(path).lambda_g in (1.0, 2.0) and seen <= {1.0, 2.0}
    assert only(path)


def test_permissions_and_links_stay(path, kind, tmp_path):
    path.chmod(0o600)
    link = tmp_path / "link"
    link.symlink_to(path)
    small_layer(lambda_g=7.0).save(link)
    assert link.is_symlink() and path.stat().st_mode & 0o777 == 0o600
    assert dpc.DPCLayer.load(path).lambda_g == 7.0


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="cannot be written: it is no regular file"):
        files.write_whole(tmp_path / "pipe", b"")
