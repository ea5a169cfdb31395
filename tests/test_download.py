"""Downloads from a real server on this machine: one that cuts, lies, or serves what it should not."""

import hashlib
import io
import socket
import stat
import threading
import zipfile
from contextlib import suppress
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from nextview.data import downloading
from nextview.data.downloading import PATIENCE, Archive
from nextview.data.lock import only_one
from nextview.errors import DatasetError, NextviewError, UsageError

download = partial(downloading.download, pause=0)
MESH = b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


def zipped(members: dict[str, bytes], links: dict[str, str] | None = None) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(name, data)
        for name, target in (links or {}).items():
            info = zipfile.ZipInfo(name)
            info.external_attr = (stat.S_IFLNK | 0o777) << 16
            file.writestr(info, target)
    return out.getvalue()


NOISE = np.random.default_rng(0).bytes(600_000)
GOOD = zipped(
    {"Shapes/chair/train/a.off": MESH, "Shapes/chair/test/noise.bin": NOISE, "__MACOSX/x": b"no", "r.txt": b""}
)


class Server:
    """Serves ``data``; each connection follows the next of ``plans``, the last one from then on."""

    def __init__(self, data: bytes, *plans: dict):
        self.data, self.plans, self.ranges = data, list(plans) or [{}], []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                plan = outer.plans.pop(0) if len(outer.plans) > 1 else outer.plans[0]
                outer.ranges.append(self.headers.get("Range"))
                if status := plan.get("status"):
                    self.send_error(status)
                    return
                asked = self.headers.get("Range") if plan.get("ranges", True) else None
                start = int(asked.removeprefix("bytes=").rstrip("-")) if asked else 0
                body = outer.data[start:]
                self.send_response(206 if asked else 200)
                announced = plan.get("announce", len(outer.data)) - start
                if plan.get("length", True):
                    self.send_header("Content-Length", str(announced))
                for name, value in plan.get("headers", {}).items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(body[: plan.get("cut", len(body))])

            def log_message(self, *args):
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_address[1]}/shapes.zip"

    def __enter__(self):
        threading.Thread(target=self.http.serve_forever, args=(0.01,), daemon=True).start()
        return self

    def __exit__(self, *error):
        self.http.shutdown()
        self.http.server_close()

    def archive(self, of: bytes | None = None) -> Archive:
        published = self.data if of is None else of
        return Archive(self.url, len(published), hashlib.sha256(published).hexdigest(), "Shapes")


def left(folder) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.suffix != ".lock")


def test_download_unpacks_only_its_folder_and_leaves_nothing_else(tmp_path):
    with Server(GOOD) as server:
        steps = list(download(server.archive(), tmp_path))
        assert (tmp_path / "Shapes/chair/train/a.off").read_bytes() == MESH
        assert (tmp_path / "Shapes/chair/test/noise.bin").read_bytes() == NOISE
        assert left(tmp_path) == ["Shapes/chair/test/noise.bin", "Shapes/chair/train/a.off"]
        assert list(dict.fromkeys(s[0] for s in steps)) == ["downloading", "verifying", "unpacking"]
        assert steps[-1][1] == steps[-1][2] == len(MESH) + len(NOISE)
        assert list(download(server.archive(), tmp_path)) == []  # there already
        assert len(server.ranges) == 1


def test_a_cut_connection_is_resumed_from_where_it_was(tmp_path):
    with Server(GOOD, {"cut": 200_000}, {"cut": 100_000}, {"status": 503}, {}) as server:
        list(download(server.archive(), tmp_path))
        assert server.ranges == [None, "bytes=200000-", "bytes=300000-", "bytes=300000-"]
    assert (tmp_path / "Shapes/chair/test/noise.bin").read_bytes() == NOISE


def test_a_stopped_download_goes_on_in_the_next_run(tmp_path):
    with Server(GOOD, {"cut": 200_000}, {"cut": 0}) as server:
        with pytest.raises(DatasetError, match=f"200000 of {len(GOOD)} bytes are kept"):
            list(download(server.archive(), tmp_path))
        assert left(tmp_path) == ["Shapes.zip.part"]
        server.plans = [{}]
        server.ranges.clear()
        list(download(server.archive(), tmp_path))
        assert server.ranges == ["bytes=200000-"]
    assert (tmp_path / "Shapes/chair/train/a.off").read_bytes() == MESH


def test_a_server_without_ranges_starts_over(tmp_path):
    with Server(GOOD, {"cut": 200_000}, {"ranges": False}) as server:
        list(download(server.archive(), tmp_path))
    assert (tmp_path / "Shapes/chair/test/noise.bin").read_bytes() == NOISE


def test_a_server_without_ranges_that_always_cuts_is_not_asked_for_ever(tmp_path, monkeypatch):
    waited = []
    monkeypatch.setattr("time.sleep", waited.append)
    with Server(GOOD, {"cut": 200_000, "ranges": False}) as server:
        with pytest.raises(DatasetError, match=rf"the connection .*; 200000 of {len(GOOD)} bytes are kept, try again"):
            list(downloading.download(server.archive(), tmp_path))
        assert len(server.ranges) == 1 + PATIENCE
    assert waited == [1, 2, 4, 8, 16]


def test_bytes_that_came_before_do_not_count_as_new(tmp_path):
    (tmp_path / "Shapes.zip.part").write_bytes(GOOD[:300_000])
    with Server(GOOD, {"cut": 200_000, "ranges": False}) as server:
        with pytest.raises(DatasetError, match="try again"):
            list(download(server.archive(), tmp_path))
        assert len(server.ranges) == PATIENCE


@pytest.mark.parametrize(
    ("headers", "sentence"),
    [
        ({"Content-Length": "many"}, "announces 'many' bytes, which is no number"),
        ({"Content-Length": "-5"}, "announces '-5' bytes, which is no number"),
        ({"Content-Length": ""}, "announces '' bytes, which is no number"),
        ({"Content-Length": "\u0663"}, "which is no number"),
        ({"Content-Range": "bytes 0-99/100"}, "asked for the bytes from 100 on, the server sends 'bytes 0-99/100'"),
        ({"Content-Range": "nonsense"}, "the server sends 'nonsense'"),
    ],
)
def test_headers_that_make_no_sense_get_one_sentence(tmp_path, headers, sentence):
    (tmp_path / "Shapes.zip.part").write_bytes(GOOD[:100])
    headers = {name: value.encode().decode("latin-1") for name, value in headers.items()}
    plan = {"headers": headers, "length": "Content-Length" not in headers}
    with Server(GOOD, plan) as server, pytest.raises(DatasetError, match=sentence) as refusal:
        list(download(server.archive(), tmp_path))
    assert "\n" not in str(refusal.value)
    assert len(server.ranges) == 1


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # urllib leaves what it stumbles over
@pytest.mark.parametrize(
    "reply",
    [
        "302 Found\r\nLocation: /",  # for ever; Python's own message has three lines
        "302 Found\r\nLocation: http://[::1/x",
        "302 Found\r\nLocation: http://" + "\xe4" * 70 + ".x/",
        f"200 OK\r\nContent-Length: {'9' * 5000}",  # more digits than Python takes
        f"404 {'x' * 60_000}",
        "404 \x1b[31mred\x07",
        "-1 what",
    ],
)
def test_whatever_a_server_says_is_one_short_sentence(tmp_path, reply):
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def serve():
            with suppress(OSError):
                while True:
                    connection, _ = listening.accept()
                    with connection:
                        connection.recv(65536)
                        connection.sendall(f"HTTP/1.1 {reply}\r\n\r\n".encode("latin-1"))

        threading.Thread(target=serve, daemon=True).start()
        archive = Archive(f"http://127.0.0.1:{listening.getsockname()[1]}/shapes.zip", 100, "0" * 64, "Shapes")
        with pytest.raises(DatasetError) as refused:
            list(download(archive, tmp_path))
        listening.shutdown(socket.SHUT_RDWR)
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize(
    "wrong", [{"url": 5}, {"size": "many"}, {"size": 0}, {"sha256": None}, {"folder": "../up"}, {"folder": ""}]
)
def test_an_archive_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(NextviewError):
        replace(Archive("http://127.0.0.1/x.zip", 1, "0" * 64, "Shapes"), **wrong)


@pytest.mark.parametrize("wrong", [{"timeout": -1}, {"timeout": "long"}, {"timeout": 1e300}, {"pause": -1}])
def test_times_that_make_no_sense_are_refused(tmp_path, wrong):
    with pytest.raises(UsageError, match=f"the {next(iter(wrong))} is "):
        list(downloading.download(Archive("http://127.0.0.1/x.zip", 1, "0" * 64, "Shapes"), tmp_path, **wrong))


def test_a_file_or_an_empty_folder_is_no_dataset(tmp_path):
    (tmp_path / "Shapes").mkdir()
    with Server(GOOD) as server:
        list(download(server.archive(), tmp_path))
        assert (tmp_path / "Shapes/chair/train/a.off").read_bytes() == MESH
        (tmp_path / "other").mkdir()
        (tmp_path / "other/Shapes").write_text("mine")
        with pytest.raises(DatasetError, match="Shapes: is a file where the dataset's folder has to be; move it away"):
            list(download(server.archive(), tmp_path / "other"))
        assert len(server.ranges) == 1
    assert (tmp_path / "other/Shapes").read_text() == "mine"


@pytest.mark.parametrize("announce", [len(GOOD) - 1, len(GOOD) + 1])
def test_a_wrong_announced_size_is_refused(tmp_path, announce):
    with Server(GOOD, {"announce": announce}) as server, pytest.raises(DatasetError, match=f"announces {announce} "):
        list(download(server.archive(), tmp_path))
    assert left(tmp_path) == []


def test_more_bytes_than_published_are_not_read(tmp_path):
    with Server(GOOD + b"x" * 1_000_000, {"length": False}) as server:
        list(download(server.archive(of=GOOD), tmp_path))
    assert (tmp_path / "Shapes/chair/train/a.off").read_bytes() == MESH


def test_other_bytes_of_the_same_size_are_refused_and_removed(tmp_path):
    with Server(GOOD[:-1] + b"!") as server, pytest.raises(DatasetError, match="SHA-256 differs"):
        list(download(server.archive(of=GOOD), tmp_path))
    assert left(tmp_path) == []


def test_missing_file_and_missing_server(tmp_path):
    with Server(GOOD, {"status": 404}) as server, pytest.raises(DatasetError, match="404"):
        list(download(server.archive(), tmp_path))
    with pytest.raises(DatasetError, match="the connection fails"):  # the server is gone now
        list(download(server.archive(), tmp_path))


@pytest.mark.parametrize(
    ("members", "links"),
    [
        ({"Shapes/a.off": MESH, "../outside.off": MESH}, {}),
        ({"Shapes/a.off": MESH, "Shapes/../../outside.off": MESH}, {}),
        ({"Shapes/a.off": MESH, "/tmp/nextview-outside.off": MESH}, {}),
        ({"Shapes/a.off": MESH, "..\\outside.off": MESH}, {}),
        ({"Shapes/a.off": MESH, "C:/outside.off": MESH}, {}),
        ({"Shapes/a.off": MESH}, {"Shapes/link": "/etc"}),
        ({"Other/a.off": MESH}, {}),
    ],
)
def test_hostile_archives_leave_nothing(tmp_path, members, links):
    destination = tmp_path / "in" / "here"
    with Server(zipped(members, links)) as server, pytest.raises(DatasetError, match=r"refused|holds no folder"):
        list(download(server.archive(), destination))
    assert left(tmp_path) in ([], ["in/here/Shapes.zip.part"])
    assert not (destination / "Shapes").exists()
    assert not (destination / "Shapes.part").exists()


def test_a_damaged_member_leaves_no_partial_tree(tmp_path):
    data = bytearray(GOOD)
    data[len(data) // 2] ^= 0xFF  # inside the noise: its CRC no longer fits
    with Server(bytes(data)) as server, pytest.raises(DatasetError, match="cannot be unpacked"):
        list(download(server.archive(), tmp_path))
    assert not (tmp_path / "Shapes").exists()
    assert not (tmp_path / "Shapes.part").exists()


def test_an_archive_that_would_not_fit_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 1000}))
    with Server(GOOD) as server, pytest.raises(DatasetError, match="only 1000 are free"):
        list(download(server.archive(), tmp_path))
    assert left(tmp_path) == ["Shapes.zip.part"]


def test_two_downloads_to_one_place_refuse_each_other(tmp_path):
    with Server(GOOD) as server, only_one(tmp_path / "Shapes"), pytest.raises(DatasetError, match="another run"):
        list(download(server.archive(), tmp_path))
