"""Watching a folder: a run after each change, nothing said twice, and an end where nothing comes."""

import pytest

from stcal import workflows
from stcal.errors import DegenerateError
from stcal.workflows.growing import GrowingRun, Update, WatchOptions, watch
from tests.outcome import fails_with
from tests.shared import own_copy

UPDATE = Update(8, (), (), (), None, "two groups needed", None, {})


def watched(data, folder, out, sleep, **options):
    files = data / "cameras.txt", out, data / "target.toml", data / "board.toml"
    return watch(folder, *files, WatchOptions(interval_s=0.1, idle_s=0.35, **options), sleep=sleep)


@pytest.mark.slow
def test_a_calibration_grows_while_photographs_come(small_dataset, tmp_path):
    """Photographs come one by one, a group at a time; one of them in two pieces; one is taken away at the end."""
    folder, out = tmp_path / "images", tmp_path / "run"
    folder.mkdir()
    coming = [path.relative_to(small_dataset / "images") for path in sorted((small_dataset / "images").glob("1[24]/*"))]
    first, group = coming[0], [path for path in coming if path.parent.name == "12"]

    def put(path, share=1.0):
        if path != first and (folder / path).exists():
            return
        content = (small_dataset / "images" / path).read_bytes()
        (folder / path.parent).mkdir(exist_ok=True)
        (folder / path).write_bytes(content[: int(share * len(content))])

    steps = iter(
        [
            lambda: put(first, 0.5),
            lambda: put(first),
            lambda: None,
            lambda: [put(path) for path in group if path != first],
            lambda: None,
            lambda: [put(path) for path in coming if path != first],
            lambda: None,
            lambda: (folder / coming[-1]).unlink(),
        ]
    )
    updates = list(watched(small_dataset, folder, out, lambda _: next(steps, lambda: None)(), views=0))
    assert updates[0].result is None
    assert "2 needed" in updates[0].reason
    assert [each.observations.name for each in updates[0].new] == [first.as_posix()]
    named = [each.observations.name for update in updates for each in update.new]
    assert sorted(named) == [path.as_posix() for path in coming]
    assert not any(update.left_out for update in updates)
    assert updates[-1].gone == (coming[-1].as_posix(),)
    assert updates[-1].result is not None
    assert len(updates[-1].result.labelled) == len(coming) - 1
    assert 'http-equiv="refresh"' in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_advice_comes_with_the_run(small_dataset, tmp_path):
    (update,) = watched(small_dataset, small_dataset / "images", tmp_path / "run", lambda _: None)
    assert len(update.advice.choices) == 1
    assert update.images == len(update.result.labelled)


@pytest.mark.slow
def test_advice_that_cannot_be_given_is_told(small_dataset, tmp_path, monkeypatch):
    def none(*_):
        raise DegenerateError("E-TEST", "no view")

    monkeypatch.setattr("stcal.workflows.growing.advise", none)
    (update,) = watched(small_dataset, small_dataset / "images", tmp_path / "run", lambda _: None)
    assert (update.result is None, update.advice, update.reason) == (False, None, "no view")


def test_the_command_and_the_function_look_alike(stcal_sfm, small_dataset, tmp_path, monkeypatch):
    """The runs themselves are those of the slow tests above."""
    said = []
    monkeypatch.setattr(GrowingRun, "update", lambda self, count, *_, **__: said.append((self.out, count)) or UPDATE)
    files = [small_dataset / name for name in ("cameras.txt", "target.toml", "board.toml")]
    words = "--camera", files[0], "--target", files[1], "--board", files[2], "--idle", "0.15", "--interval", "0.1"
    ended = stcal_sfm("watch", small_dataset / "images", *words, "--out", tmp_path / "one")
    assert ended[0] == 0
    assert UPDATE.reason in ended[1]
    options = workflows.WatchOptions(0.1, 0.15)
    (update,) = workflows.watch(
        small_dataset / "images", files[0], tmp_path / "two", *files[1:], options, sleep=lambda _: None
    )
    assert update is UPDATE
    assert [count for _, count in said] == [8, 8]
    with fails_with("E-FIELD-TYPE … options"):
        workflows.watch(small_dataset / "images", files[0], tmp_path, options=0.1)


def test_an_empty_folder_ends_and_none_is_an_error(small_dataset, tmp_path):
    (tmp_path / "images").mkdir()
    assert list(watched(small_dataset, tmp_path / "images", tmp_path / "run", lambda _: None)) == []
    with fails_with("E-IMAGES-FOLDER"):
        next(watched(small_dataset, tmp_path / "nowhere", tmp_path / "run", lambda _: None))
    with fails_with("E-OPTION-RANGE"):
        WatchOptions(interval_s=0)


def test_a_folder_that_goes_is_told(small_dataset, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    with fails_with("E-IMAGES-FOLDER … disappeared"):
        list(watched(small_dataset, folder, tmp_path / "run", lambda _: folder.rmdir() if folder.is_dir() else None))


def test_photographs_that_all_go_are_told(small_dataset, tmp_path):
    """As where the disk is unmounted whose files were watched: the folder is there, and empty."""
    folder = tmp_path / "images"
    folder.mkdir()
    names = ["a.jpg", "b.jpg"]

    def put():
        for name in names:
            (folder / name).write_bytes(b"x")

    def take():
        for name in names:
            (folder / name).unlink()

    steps = iter([put, lambda: None, take])
    came, empty = watched(small_dataset, folder, tmp_path / "run", lambda _: next(steps, lambda: None)())
    assert (came.images, came.gone) == (2, ())
    assert (empty.images, empty.gone, empty.result) == (0, tuple(names), None)
    assert str(folder) in empty.reason


def test_a_photograph_counts_when_two_looks_agree_and_no_other_is_used(small_dataset, tmp_path, monkeypatch):
    """One is renamed when the others are used: it is not complete under its new name."""
    used = []

    def update(self, images, came, gone, progress, complete):
        if not used:
            (folder / "b.jpg").rename(folder / "c.jpg")
        files, _ = self._files(complete)
        used.append([file.name for file in files])

    monkeypatch.setattr("stcal.workflows.growing.GrowingRun.update", update)
    folder = tmp_path / "images"
    folder.mkdir()
    for name in "ab":
        (folder / f"{name}.jpg").write_bytes(b"x")
    list(watched(small_dataset, folder, tmp_path / "run", lambda _: None))
    assert used == [["a.jpg"], ["a.jpg"], ["a.jpg", "c.jpg"]]


def test_a_folder_that_is_no_runs_is_refused(small_dataset, tmp_path):
    other = tmp_path / "mine"
    other.mkdir()
    own_copy(small_dataset / "target.toml", other / "notes.txt")
    with fails_with("E-OUTPUT-EXISTS … mine"):
        next(watched(small_dataset, small_dataset / "images", other, lambda _: None))
