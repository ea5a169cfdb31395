"""Downloads from a real server on this machine: one that cuts, lies, or serves what it should
not.
"""

import gc
import hashlib
import io
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from nextview.errors import DatasetError
from nextview_lab.data.downloading import Archive, download

MESH = b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
NOISE = np.random.default_rng(0).bytes(600_000)


def zipped(members: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return out.getvalue()


GOOD = zipped(
    {
        "Shapes/chair/train/a.off": MESH,
        "Shapes/chair/test/noise.bin": NOISE,
        "__MACOSX/x": b"no",
        "../r.txt": b"",
    }
)


class Server:
    """Serves ``data``, of which it sends so many bytes, with a status."""

    def __init__(self, data: bytes, cut: int | None = None, status: int = 200):
        self.data, self.requests = data, 0
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                outer.requests += 1
                self.send_response(status)
                self.send_header("Content-Length", str(len(outer.data)))
                self.end_headers()
                self.wfile.write(outer.data[:cut])

            def log_message(self, *args):
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_address[1]}/shapes.zip"

    def __enter__(self):
        threading.Thread(
            target=self.http.serve_forever, args=(0.01,), daemon=True
        ).start()
        return self

    def __exit__(self, *error):
        self.http.shutdown()
        self.http.server_close()

    def archive(self, published: bytes | None = None) -> Archive:
        return Archive(
            self.url, hashlib.sha256(published or self.data).hexdigest(), "Shapes"
        )


def test_download_unpacks_only_its_folder_once_and_leaves_nothing_else(tmp_path):
    with Server(GOOD) as server:
        assert download(server.archive(), tmp_path / "data") == tmp_path / "data/Shapes"
        download(server.archive(), tmp_path / "data")  # there already
        assert server.requests == 1
    left = sorted(
        str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()
    )
    assert left == ["data/Shapes/chair/test/noise.bin", "data/Shapes/chair/train/a.off"]
    assert (tmp_path / "data/Shapes/chair/train/a.off").read_bytes() == MESH


# requests leaves its socket open until it is collected
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("options", "published", "sentence"),
    [
        ({"cut": 300_000}, GOOD, "IncompleteRead|differs|does not match|broken"),
        ({"status": 404}, GOOD, "404"),
        ({}, b"something else", "does not match|differs"),
        ({"data": b"no zip"}, b"no zip", "not a zip"),
        ({"data": zipped({"Other/a.off": MESH})}, None, "holds no folder Shapes"),
    ],
)
def test_a_download_with_a_wrong_hash_leaves_no_files(
    tmp_path, options, published, sentence
):
    with (
        Server(**{"data": GOOD} | options) as server,
        pytest.raises(DatasetError, match=sentence) as refusal,
    ):
        download(server.archive(published), tmp_path)
    assert "\n" not in str(refusal.value)
    assert list(tmp_path.iterdir()) == []
    del refusal
    gc.collect()
