"""Outputs replace nothing without a request."""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
import stat

from cards import filmed, pose
from commands import full_disk
from djet_ros.cli.main import main
from djet_ros.config.sections import Config
from djet_ros.errors import DjetError
from djet_ros.lab.store import FILE_NAME, RecordStore
from djet_ros.lab.style import figure
from djet_ros.recordings.outputs import check_ours, replaced_together, write_whole
from djet_ros.replay.results import plot_trajectory, ResultsFolder
import numpy as np
import pytest


@dataclass(frozen=True)
class Count:
    """The plainest record."""

    number: int


def held(folder: Path) -> dict[str, str]:
    """Return the files of a folder with their content."""
    return {path.name: path.read_text('utf-8') for path in folder.iterdir()}


def test_a_file_is_written_without_touching_any_other(tmp_path: Path) -> None:
    mine = {f'{before}bashrc{after}': 'mine' for before in ('.', '_') for after in ('', '~')}
    for name, text in mine.items():
        (tmp_path / name).write_text(text, 'utf-8')
    write_whole(tmp_path / 'bashrc', 'ours')
    assert held(tmp_path) == {**mine, 'bashrc': 'ours'}


def test_a_file_written_atomically_has_the_permissions_of_a_new_file(tmp_path: Path) -> None:
    for umask in (0o022, 0o027, 0o077):
        before = os.umask(umask)
        try:
            (tmp_path / 'plain').write_text('x', 'utf-8')
            write_whole(tmp_path / 'whole', 'x')
        finally:
            os.umask(before)
        modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ('plain', 'whole')}
        assert modes == {0o666 & ~umask}
        (tmp_path / 'plain').unlink()


def test_a_file_that_can_not_be_written_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / 'folder' / 'of').mkdir(parents=True)
    with pytest.raises(OSError):
        write_whole(tmp_path / 'folder', 'x')
    assert [path.name for path in tmp_path.iterdir()] == ['folder']


def test_a_figure_that_can_not_be_written_leaves_the_earlier_one_and_is_named(
        tmp_path: Path) -> None:
    path = tmp_path / 'plot.png'
    path.write_bytes(b'earlier')
    with full_disk(), pytest.raises(OSError, match='File too large') as caught, \
            figure(path, 3, 3):
        pass
    assert caught.value.filename == str(path)
    with full_disk(), pytest.raises(DjetError, match='plot.png could not be written: File too'):
        plot_trajectory(path, np.zeros((2, 3)), None, np.empty((0, 2), np.float32), 'none', 'm')
    assert held(tmp_path) == {'plot.png': 'earlier'}


def test_files_of_a_run_replace_those_of_an_earlier_one_all_or_none(tmp_path: Path) -> None:
    names = ('graph', 'plot', 'truth')
    earlier = {'graph': 'earlier', 'truth': 'earlier', 'notes': 'mine'}
    for name, text in earlier.items():
        (tmp_path / name).write_text(text, 'utf-8')
    for error in (OSError('full'), KeyboardInterrupt()):
        with pytest.raises(type(error)), replaced_together(tmp_path, names, True) as new:
            (new / 'graph').write_text('new', 'utf-8')
            assert {path.name for path in tmp_path.iterdir()} == {*earlier, new.name}
            raise error
        assert held(tmp_path) == earlier
    with pytest.raises(DjetError, match='--overwrite'), replaced_together(tmp_path, names, False):
        pass
    with replaced_together(tmp_path, names, True) as new:
        for name in ('graph', 'plot'):
            (new / name).write_text('new', 'utf-8')
    assert held(tmp_path) == {'graph': 'new', 'plot': 'new', 'notes': 'mine'}


@pytest.mark.parametrize('present', [False, True])
def test_results_that_cannot_be_started_leave_the_folder_unchanged(
        present: bool, tmp_path: Path) -> None:
    place = tmp_path / 'results'
    if present:
        place.mkdir()
    with full_disk(), pytest.raises(DjetError,
                                    match='results could not be created: File too large'):
        ResultsFolder(place, Config())
    assert list(tmp_path.rglob('*')) == ([place] if present else [])
    ResultsFolder(place, Config()).close()
    begun = {path: path.stat().st_mtime_ns for path in place.rglob('*') if path.is_file()}
    with full_disk(), pytest.raises(DjetError, match='File too large'):
        ResultsFolder(place, Config(), overwrite=True)
    assert {path: path.stat().st_mtime_ns for path in place.rglob('*') if path.is_file()} == begun


@pytest.mark.parametrize('verb', [('bench', 'sequence'), ('closure', 'sequence'), ('soak',)])
def test_figures_are_json_and_their_plot_replaces_no_other_image(
        verb: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'f.png').write_text('my photo', 'utf-8')
    for name, why in (('g.png', 'its name must end in .json'),
                      ('f.json', f'{tmp_path / "f.png"} exists already; choose another name')):
        assert main(['lab', *verb, '--output', str(tmp_path / name)]) == 2
        stderr = capsys.readouterr().err
        assert why in stderr
        assert stderr.count('\n') == 1
    assert held(tmp_path) == {'f.png': 'my photo'}


@pytest.mark.parametrize('verb', [
    ('lens', 'images'), ('lab', 'evaluate', 'images'), ('lab', 'ablate', 'images'),
    ('lab', 'coverage', '--scenes', 'road'), ('lab', 'beside'), ('lab', 'lengths')])
def test_results_are_not_put_among_the_files_of_others(
        verb: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / '000000.png').write_text('of a recording', 'utf-8')
    assert main([*verb, '--overwrite', '--output', str(tmp_path)]) == 2
    assert capsys.readouterr().err == (
        f'djet: error: {tmp_path} is not empty and holds no earlier results; choose another '
        '--output\n')
    assert held(tmp_path) == {'000000.png': 'of a recording'}


def test_what_an_interrupted_run_has_left_is_not_of_others(tmp_path: Path) -> None:
    check_ours(tmp_path / 'new', ('plots',), FILE_NAME)
    for name in ('plots', '.frames-7', FILE_NAME, 'notes.txt'):
        (tmp_path / name).touch()
        check_ours(tmp_path, ('plots',), FILE_NAME)
    (tmp_path / FILE_NAME).unlink()
    with pytest.raises(DjetError, match='is not empty and holds no earlier results'):
        check_ours(tmp_path, ('plots',), FILE_NAME)


@pytest.mark.parametrize('verb', [
    ('bench', 'sequence'), ('closure', 'sequence'), ('soak', '--frames', '100')])
def test_figures_without_a_place_are_refused_before_they_are_measured(
        verb: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    # No mode holds root back, but nobody creates files there.
    assert main(['lab', *verb, '--output', '/proc/f.json']) == 2
    assert capsys.readouterr().err.startswith('djet: error: /proc/f.json could not be created: ')


def test_figures_that_find_a_full_disk_are_named(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / 'results' / 'f.json'
    sequence = filmed(tmp_path / 'sequences' / '00', [pose(x=0.25 * i) for i in range(3)])
    with full_disk():
        assert main(['lab', 'closure', str(sequence), '--methods', 'rpe', '--output',
                     str(output)]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f'djet: error: {output}: File too large'
    assert list(output.parent.iterdir()) == []


@pytest.mark.parametrize('text', [
    'groceries', 'bread\nmilk', '{"shop": "corner"}\n{"item": "bread"}', '{"shop": "corner"}\n'])
def test_foreign_records_are_refused_and_left_unchanged(text: str, tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).write_text(text, 'utf-8')
    with pytest.raises(DjetError, match='--overwrite'):
        RecordStore(tmp_path, Count, {'frames': 3})
    assert held(tmp_path) == {FILE_NAME: text}


def test_records_of_a_killed_run_lose_only_the_line_that_was_cut(tmp_path: Path) -> None:
    with RecordStore(tmp_path, Count, {'frames': 3}) as store:
        store.add('a', [Count(1), Count(2)])
    whole = held(tmp_path)
    with (tmp_path / FILE_NAME).open('a', encoding='utf-8') as file:
        file.write('{"chunk": "b", "reco')
    with RecordStore(tmp_path, Count, {'frames': 3}) as store:
        assert store.chunks == {'a': [Count(1), Count(2)]}
        assert held(tmp_path) == whole
        store.add('b', [Count(3)])
    with RecordStore(tmp_path, Count, {'frames': 3}) as store:
        assert store.chunks == {'a': [Count(1), Count(2)], 'b': [Count(3)]}
