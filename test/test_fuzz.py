"""
Whatever strangers send: a result or an error of ours in one line, and no more memory than fits.

The same targets are fuzzed with coverage as a guide by ``make fuzz``.
"""

import ast
from pathlib import Path
import resource

import djet_ros
from fuzz_targets import outcomes, TARGETS
from mutation import mutations
import pytest

# Room for what a target may take: a piece of 128 MB that a file announces, and a copy of it.
ROOM = 400 << 20

# Inputs for each target; those that take milliseconds get the fewer.
MANY, FEW = 300, 60
QUICK = {'image', 'compressed_image', 'truth_and_speed', 'trajectory', 'metadata', 'config'}


@pytest.fixture
def little_memory():
    """Let this process take no more than ROOM beyond what it has."""
    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)


@pytest.mark.parametrize('name', TARGETS)
def test_a_target_takes_its_seeds(name):
    outcomes.clear()
    for data in TARGETS[name].seeds():
        TARGETS[name].run(data)
    assert outcomes['taken'] > 0, 'a target that refuses all of its seeds tests nothing'


@pytest.mark.filterwarnings('ignore::RuntimeWarning')
@pytest.mark.parametrize('name', TARGETS)
def test_damaged_input_gives_a_result_or_an_error_of_ours(name, little_memory):
    target = TARGETS[name]
    for data in mutations(target.seeds(), MANY if name in QUICK else FEW, seed=len(name)):
        target.run(data)


@pytest.mark.slow
def test_only_safe_loading_and_no_code_from_data():
    forbidden = {'pickle', 'cPickle', 'dill', 'marshal', 'shelve', 'joblib', 'cloudpickle'}
    for path in Path(djet_ros.__file__).parent.rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            where = f'{path}:{getattr(node, "lineno", 0)}'
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {alias.name.partition('.')[0] for alias in node.names}
                names.add((getattr(node, 'module', None) or '').partition('.')[0])
                assert not names & forbidden, where
            elif isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in ('eval', 'exec', 'compile', '__import__', 'os.system'), where
                assert not [word for word in node.keywords if word.arg in ('allow_pickle', 'shell')
                            and ast.unparse(word.value) != 'False'], where
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == 'yaml':
                assert node.attr in ('SafeLoader', 'YAMLError', 'CollectionNode', 'MappingNode',
                                     'ScalarNode', 'safe_dump'), where
