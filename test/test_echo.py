"""What ``djet echo`` shows of a node: that node's, and as it was said."""

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


def test_the_state_shown_is_that_of_the_node_and_of_no_other() -> None:
    view = Monitor('left/vo_node')
    for other in ('right/vo_node', 'vo_node', 'very/left/vo_node'):
        view.diagnostics(diagnostics(other, 'lost'))
    view.diagnostics(diagnostics('left/vo_node', 'lost', 'pose graph'))
    assert (view.summary, view.news) == ('nothing heard yet', False)
    view.diagnostics(diagnostics('left/vo_node', 'tracking'))
    view.diagnostics(diagnostics('right/vo_node', 'lost'))
    assert (view.summary, view.values) == ('tracking', {'frames processed': '9'})


@pytest.mark.parametrize('said', ['tracking [/b]', '[red]tracking', 'no mask of [/camera/image]'])
def test_a_state_is_shown_as_it_was_said_brackets_and_all(said: str) -> None:
    view = Monitor('vo_node')
    view.diagnostics(diagnostics('vo_node', said))
    view.values['matches'] = said
    assert shown(view.table()).count(said) == 2


def test_a_recording_may_be_named_with_brackets() -> None:
    name = 'drive [/b] [red]'
    table = new_table(f'{name}: djet', name)
    table.add_row(name)
    assert shown(table).count(name) == 3
    assert name in shown(f'page: {name}')
