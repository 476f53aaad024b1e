"""What ``djet echo`` shows: the diagnostics of the named node only, and unchanged."""

from __future__ import annotations

import io

from djet_ros.cli.echo import Monitor
from djet_ros.cli.terminal import console, new_table
from djet_ros.recordings.decoding import MAKE
import pytest


def diagnostics(node: str, summary: str, what: str = 'visual odometry') -> object:
    """Make the diagnostics message of a node."""
    return MAKE.diagnostics(1, f'{node}: {what}', 'ERROR', summary, {'frames processed': '9'})


def shown(printed: object) -> str:
    """Print something as the commands do."""
    out = console()
    out.file = io.StringIO()
    out.print(printed)
    return out.file.getvalue()


def test_only_the_status_of_the_named_node_is_shown() -> None:
    view = Monitor('left/vo_node')
    for other in ('right/vo_node', 'vo_node', 'very/left/vo_node'):
        assert not view.diagnostics(diagnostics(other, 'lost'))
    assert not view.diagnostics(diagnostics('left/vo_node', 'lost', 'pose graph'))
    assert view.summary == 'no diagnostics received yet'
    assert view.diagnostics(diagnostics('left/vo_node', 'tracking'))
    assert not view.diagnostics(diagnostics('right/vo_node', 'lost'))
    assert (view.summary, view.values) == ('tracking', {'frames processed': '9'})


@pytest.mark.parametrize('text', ['tracking [/b]', '[red]tracking', 'no mask of [/camera/image]'])
def test_brackets_in_a_status_are_not_interpreted_as_markup(text: str) -> None:
    view = Monitor('vo_node')
    view.diagnostics(diagnostics('vo_node', text))
    view.values['matches'] = text
    assert shown(view.table()).count(text) == 2


def test_brackets_in_the_name_of_a_recording_are_not_interpreted_as_markup() -> None:
    name = 'drive [/b] [red]'
    table = new_table(f'{name}: djet', name)
    table.add_row(name)
    assert shown(table).count(name) == 3
    assert name in shown(f'page: {name}')
