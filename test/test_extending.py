"""The examples of doc/extending.md work: the new method and scene take part."""

from __future__ import annotations

from pathlib import Path
import re

from djet_ros.core.types import Status
from djet_ros.lab import methods, peers
from djet_ros.lab.methods import make_methods
from djet_ros.lab.pairs import evaluate_chunk, PairChunk
from djet_ros.lab.plots import grouped, plot_boxes, plot_cumulative, plot_errors_by_frame
from djet_ros.lab.scenes import render_sequence, SCENES
from djet_ros.lab.sequences import open_datasets, Selection
from djet_ros.lab.summary import table_rows
from djet_ros.lab.tables import results_table
import pytest

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[1] / 'doc' / 'extending.md'


@pytest.fixture
def extended(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the examples of the page, and restore the dictionaries afterwards."""
    for table in (peers.ESTIMATORS, methods.PEERS, methods.TITLES, SCENES):
        for name in ('least_median', 'dusk'):
            monkeypatch.setitem(table, name, None)
            del table[name]  # type: ignore[attr-defined]
    scope: dict[str, object] = {}
    for code in re.findall(r'```python\n(.*?)```', PAGE.read_text(), re.DOTALL):
        exec(code, scope)


@pytest.mark.usefixtures('extended')
def test_the_new_method_and_scene_are_measured_listed_and_drawn(tmp_path: Path) -> None:
    folder = render_sequence('dusk', tmp_path, 3, size=(480, 270))
    dataset, = open_datasets([folder], Selection(), tmp_path)
    records = evaluate_chunk(PairChunk(dataset, 0, 2),
                             make_methods(['djet', 'least_median'], ['best'], {}))
    assert [record.method for record in records] == ['djet', 'least_median'] * 2
    for record in records:
        assert record.status == Status.OK
        assert not record.failed
    table = results_table('', table_rows(records), {})
    assert [line.cells[:3] for line in table.lines] == [
        (dataset.name, 'best', 'D-JET'), (dataset.name, 'best', 'LMedS')]
    for plot in (plot_errors_by_frame, plot_cumulative, plot_boxes):
        path = tmp_path / f'{plot.__name__}.png'
        plot(path, 'dusk', grouped(records))
        assert path.read_bytes().startswith(b'\x89PNG')
