"""Outputs whole or not at all, one writer at a time, typed records."""

import os
import resource
import subprocess
import sys

import msgspec
import pytest

from nextview import files
from nextview.errors import DatasetError, ModelError, ResultsError


class Record(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    values: tuple[float, ...] = ()


def everything(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_file_is_written_completely_and_replaces_others_only_on_request(tmp_path):
    path = tmp_path / "new" / "a.txt"
    with files.new_file(path) as part:
        part.write_text("old")
    with pytest.raises(ResultsError), files.new_file(path):
        pass
    with pytest.raises(RuntimeError), files.new_file(path, overwrite=True) as part:
        part.write_text("half")
        raise RuntimeError
    assert everything(tmp_path) == {"new/a.txt": "old"}
    with files.new_file(path, overwrite=True) as part:
        part.write_text("new")
    assert everything(tmp_path) == {"new/a.txt": "new"}


def test_a_folder_is_new_or_empty_and_with_overwrite_only_its_own_files_are_replaced(
    tmp_path,
):
    out = tmp_path / "out"
    out.mkdir()
    with files.new_folder(out) as part:
        (part / "sub").mkdir()
        (part / "sub" / "table.csv").write_text("1")
    (out / "mine.txt").write_text("mine")
    with pytest.raises(ResultsError), files.new_folder(out):
        pass
    with files.new_folder(out, overwrite=True) as part:
        (part / "sub").mkdir()
        (part / "sub" / "table.csv").write_text("2")
    assert everything(tmp_path) == {"out/sub/table.csv": "2", "out/mine.txt": "mine"}


def test_links_and_paths_of_another_kind_are_rejected(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    os.mkfifo(tmp_path / "pipe")
    cases = (
        ("link", False, "link"),
        ("file", True, "is a file"),
        ("file/x", False, "not a folder"),
    )
    cases += (
        ("pipe", False, "is a pipe or a device"),
        ("pipe", True, "is a pipe or a device"),
    )
    for path, folder, words in cases:
        with pytest.raises(ResultsError, match=words):
            files.check_new(tmp_path / path, overwrite=True, folder=folder)
    with pytest.raises(ResultsError):
        files.check_new(tmp_path, overwrite=True)


FULL = """
import signal
from pathlib import Path
from nextview.files import ResultsError, new_file
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
try:
    with new_file(Path("a"), True) as part:
        part.write_bytes(bytes(10**6))
except ResultsError as error:
    print(error)
"""


def test_a_full_disk_is_one_sentence_and_leaves_the_old_file(tmp_path):
    (tmp_path / "a").write_text("old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    done = subprocess.run(
        [sys.executable, "-c", FULL],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1])),
    )
    assert "cannot be written (File too large)" in done.stdout
    assert everything(tmp_path) == {"a": "old"}


def test_one_writer_at_a_time_and_no_lock_file_stays(tmp_path):
    with files.only_one(tmp_path / "store"):
        with pytest.raises(DatasetError), files.only_one(tmp_path / "store"):
            pass
    with files.only_one(tmp_path / "store"):
        pass
    assert not list(tmp_path.iterdir())


def test_records_come_back_and_what_is_none_is_one_sentence(tmp_path):
    path = tmp_path / "card.json"
    files.write_record(path, Record("a", (0.1, 1e300)))
    assert files.read_record(path, Record, "a card") == Record("a", (0.1, 1e300))
    for text in ("[", "{}", '{"name": "a", "other": 1}', "\udcff"):
        path.write_bytes(text.encode(errors="surrogateescape"))
        with pytest.raises(ModelError):
            files.read_record(path, Record, "a card")
    os.mkfifo(tmp_path / "pipe")
    for name, words in (("pipe", "is no file"), ("none", "no such file")):
        with pytest.raises(ModelError, match=words):
            files.read_record(tmp_path / name, Record, "a card")
