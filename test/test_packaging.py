"""Pip and colcon install the package, each putting everything where it is looked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.metadata import Distribution, distributions, version
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tarfile
from xml.etree import ElementTree

import djet_ros
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version
import pytest
import yaml

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
NODES = ('vo_node', 'pose_graph_node')
NOT_SOURCE = shutil.ignore_patterns('.*', '__pycache__', '*.so', '*.egg-info', 'build', 'demo',
                                    'fuzz', 'install', 'log')
COLCON = Path(sys.executable).with_name('colcon')

needs_colcon = pytest.mark.skipif(not COLCON.exists(), reason=f'no {COLCON}')


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command that has to succeed; return what it printed."""
    done = subprocess.run([str(word) for word in command], cwd=cwd, text=True, timeout=300,
                          capture_output=True, check=False)
    assert done.returncode == 0, f'{command}\n{done.stdout}\n{done.stderr}'
    return done.stdout


@pytest.fixture(scope='module', autouse=True)
def unoptimised(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """
    Compile without optimisation, which would take most of the time of each build.

    Without PYTHONPATH, as its packages are found before those that are installed here.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv('PYTHONPATH', raising=False)
        if compiler := shutil.which('cc'):
            script = tmp_path_factory.mktemp('compiler') / 'cc'
            # The last level counts.
            script.write_text(f'#!/bin/sh\nexec {compiler} "$@" -O0\n')
            script.chmod(0o755)
            patch.setenv('CC', str(script))
        yield


@pytest.fixture(scope='module')
def copied(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Copy the source tree, because builds write into it, under a new folder of this name."""
    def copy(name: str) -> Path:
        return shutil.copytree(ROOT, tmp_path_factory.mktemp(name) / 'src' / 'djet_ros',
                               ignore=NOT_SOURCE)
    return copy


@pytest.fixture(scope='module')
def environment(copied: Callable[[str], Path]) -> Path:
    """Install, without dependencies, the wheel built from the source distribution."""
    source = copied('pip')
    folder = source.parents[1]
    run(sys.executable, 'setup.py', '--quiet', 'sdist', '--dist-dir', folder, cwd=source)
    archive, = folder.glob('*.tar.gz')
    return installed(archive, folder)


def test_the_source_distribution_is_the_whole_source_tree(tmp_path: Path) -> None:
    tree = tmp_path / 'djet_ros'
    shutil.copytree(ROOT, tree, ignore=NOT_SOURCE)
    shutil.copytree(ROOT / '.ci', tree / '.ci', ignore=NOT_SOURCE)
    files = {str(path.relative_to(tree)) for path in tree.rglob('*') if path.is_file()}
    assert {'test/conftest.py', 'test/lowest.txt', 'doc/node.md', 'CHANGELOG.rst'} <= files
    run(sys.executable, 'setup.py', '--quiet', 'sdist', '--dist-dir', tmp_path, cwd=tree)
    archive, = tmp_path.glob('*.tar.gz')
    with tarfile.open(archive) as packed:
        names = {member.name.partition('/')[2] for member in packed if member.isfile()}
    assert names >= files
    made = {name for name in names - files if '.egg-info/' not in name}
    assert made == {'PKG-INFO'}


def installed(source: Path, folder: Path) -> Path:
    """Build the wheel, and install it without dependencies into a new environment in a folder."""
    pytest.importorskip('pip')
    if Version(version('setuptools')) < Version('70.1'):
        pytest.skip('setuptools before 70.1 builds no wheels by itself')
    offline = ('--no-index', '--no-deps')
    run(sys.executable, '-m', 'pip', 'wheel', *offline, '--no-build-isolation', '--wheel-dir',
        folder, source, cwd=folder)
    wheel, = folder.glob('*.whl')
    run(sys.executable, '-m', 'venv', '--without-pip', 'venv', cwd=folder)
    run(sys.executable, '-m', 'pip', '--python', folder / 'venv', 'install', *offline, wheel,
        cwd=folder)
    return folder / 'venv'


@pytest.fixture(scope='module')
def distribution(environment: Path) -> Distribution:
    """Return the metadata of the installed package."""
    packages, = environment.glob('lib/*/site-packages')
    found, = distributions(name='djet_ros', path=[str(packages)])
    return found


@pytest.fixture(scope='module', params=[[], ['--symlink-install']], ids=['copied', 'linked'])
def workspace(request: pytest.FixtureRequest, copied: Callable[[str], Path]) -> Path:
    """Build the package in a colcon workspace of its own, where it was launched from before."""
    source = copied('colcon')
    left = source / 'launch' / '__pycache__' / 'vo.launch.cpython-312.pyc'
    left.parent.mkdir()
    left.write_bytes(b'')
    folder = source.parents[1]
    run(COLCON, 'build', *request.param, cwd=folder)
    return folder


def shares_its_files(prefix: Path) -> bool:
    """Return whether all files that ROS looks for are below the prefix."""
    share = prefix / 'share' / 'djet_ros'
    wanted = [ROOT / 'package.xml', *ROOT.glob('config/*'), *ROOT.glob('launch/*.launch.*')]
    return (prefix / 'share/ament_index/resource_index/packages/djet_ros').exists() and all(
        (share / path.relative_to(ROOT)).read_bytes() == path.read_bytes() for path in wanted)


def test_pip_puts_the_commands_into_bin(environment: Path) -> None:
    assert run(environment / 'bin' / 'djet', '--version', cwd=environment) == (
        f'djet_ros {djet_ros.__version__}\n')
    for node in NODES:
        assert (environment / 'bin' / node).exists()
    assert not (environment / 'lib' / 'djet_ros').exists()
    assert shares_its_files(environment)


def test_type_checkers_see_the_types_of_the_installed_package(environment: Path) -> None:
    assert run(environment / 'bin' / 'python', '-c', 'from importlib.util import find_spec\n'
               'from pathlib import Path\n'
               'print(Path(find_spec("djet_ros").origin).with_name("py.typed").exists())',
               cwd=environment) == 'True\n'


def has_compiled_loops(python: Path, cwd: Path) -> bool:
    """Return whether the package installed for an interpreter has the compiled loops."""
    return run(python, '-c', 'from pathlib import Path\n'
               'import djet_ros\nprint(*Path(djet_ros.__file__).parent.glob("compiled/_loops*"))',
               cwd=cwd) != '\n'


@pytest.mark.skipif(shutil.which('cc') is None, reason='no C compiler')
def test_pip_compiles_inner_loops_from_the_source_distribution(environment: Path) -> None:
    assert has_compiled_loops(environment / 'bin' / 'python', environment)


def test_pip_installs_all_else_without_a_compiler(
        copied: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('CC', 'false')
    source = copied('bare')
    folder = source.parents[1]
    python = installed(source, folder) / 'bin' / 'python'
    assert not has_compiled_loops(python, folder)
    assert run(python.with_name('djet'), '--version', cwd=folder)


@needs_colcon
def test_colcon_puts_the_commands_where_ros2_run_looks(workspace: Path) -> None:
    prefix = workspace / 'install' / 'djet_ros'
    assert {path.name for path in (prefix / 'lib' / 'djet_ros').iterdir()} == {'djet', *NODES}
    assert not (prefix / 'bin').exists()
    assert shares_its_files(prefix)


@needs_colcon
def test_commands_of_colcon_do_not_require_pip_names_of_dependencies(
        workspace: Path, tmp_path: Path) -> None:
    # Ubuntu's python3-opencv does not provide a distribution 'opencv-python-headless'.
    run(sys.executable, '-m', 'venv', '--without-pip', 'bare', cwd=tmp_path)
    answer = run('bash', '-c', '. install/setup.bash; '
                 f'{tmp_path}/bare/bin/python install/djet_ros/lib/djet_ros/djet --version',
                 cwd=workspace)
    assert answer == f'djet_ros {djet_ros.__version__}\n'


@needs_colcon
def test_colcon_runs_the_tests(workspace: Path) -> None:
    run(COLCON, 'test', '--return-code-on-test-failure', '--pytest-args', 'test/test_layers.py',
        cwd=workspace)
    suite = ElementTree.parse(workspace / 'build' / 'djet_ros' / 'pytest.xml').getroot()[0]
    assert int(suite.attrib['tests']) > 0
    assert int(suite.attrib['failures']) == int(suite.attrib['errors']) == 0


def test_the_manifest_is_valid_and_agrees_with_setup_py(distribution: Distribution) -> None:
    catkin_pkg = pytest.importorskip('catkin_pkg.package')
    warnings: list[str] = []
    manifest = catkin_pkg.parse_package(str(ROOT / 'package.xml'), warnings=warnings)
    manifest.validate(warnings=warnings)
    assert not warnings
    assert manifest.package_format == 3
    assert manifest.get_build_type() == 'ament_python'
    metadata = distribution.metadata
    assert (manifest.name, manifest.version) == (metadata['Name'], metadata['Version'])
    assert manifest.licenses == [metadata['License']]
    person, = manifest.maintainers
    assert (person.name, person.email) == (metadata['Maintainer'], metadata['Maintainer-email'])
    # The packages that read the launch files, which are Python or XML.
    formats = {path.suffix for path in (ROOT / 'launch').glob('*.launch.*')}
    assert formats == {'.py', '.xml'}
    assert {'launch', 'launch_xml'} <= {one.name for one in manifest.exec_depends}


def test_the_description_of_the_package_is_the_readme(distribution: Distribution) -> None:
    metadata = distribution.metadata
    assert metadata['Description-Content-Type'] == 'text/markdown'
    text = metadata.get_payload() or metadata['Description']
    assert text.strip() == (ROOT / 'README.md').read_text('utf-8').strip()
    assert 'Operating System :: POSIX :: Linux' in metadata.get_all('Classifier')


def test_every_dependency_is_bounded_and_the_lower_bounds_are_tested(
        distribution: Distribution) -> None:
    requirements = [Requirement(line) for line in distribution.requires or []]
    lower = {}
    for requirement in requirements:
        bounds = {bound.operator: bound.version for bound in requirement.specifier}
        assert bounds.keys() == {'>=', '<'}, requirement
        if 'extra' not in str(requirement.marker):
            lower[requirement.name] = Version(bounds['>='])
    pins = re.findall('^(.+)==(.+)$', (ROOT / 'test' / 'lowest.txt').read_text(), re.MULTILINE)
    assert {name: Version(version) for name, version in pins} == lower


def test_the_pages_list_every_dependency_with_its_bounds(distribution: Distribution) -> None:
    listed = {}
    for one in yaml.safe_load((ROOT / 'doc' / 'dependencies.yaml').read_text()):
        assert len(one['reason']) > 4
        listed[one['name'].lower(), one.get('extra', '')] = SpecifierSet(one['versions'])
    needed = {}
    for requirement in map(Requirement, distribution.requires or []):
        extra = re.search(r'extra == .(\w+)', str(requirement.marker))
        if not extra or extra[1] not in ('test', 'lint'):
            needed[requirement.name.lower(), extra[1] if extra else ''] = requirement.specifier
    assert listed == needed


@pytest.mark.skipif(shutil.which('make') is None, reason='no make')
def test_the_audit_is_of_the_newest_versions_that_each_extra_allows(
        distribution: Distribution) -> None:
    commands = run('make', '--dry-run', 'audit', cwd=ROOT).splitlines()
    installed = [line for line in commands if 'pip install' in line]
    assert all('--upgrade --upgrade-strategy eager' in line for line in installed)
    extras = [set(re.search(r'\[(.+)\]', line)[1].split(',')) for line in installed]
    ours = {'fuzz', 'lint', 'test'}
    assert set.union(*extras) == {*distribution.metadata.get_all('Provides-Extra')} - ours
    # GTSAM 4.2 holds back NumPy, and that OpenCV.
    assert [one for one in extras if 'slam' in one] == [{'audit', 'slam'}]
    assert sum('.ci/audit.py' in line for line in commands) == len(extras)


def test_the_audit_fails_for_a_package_without_information(tmp_path: Path) -> None:
    answers = {'clean': '{"dependencies": [{"name": "a", "version": "1", "vulns": []}]}',
               'unknown': '{"dependencies": [{"name": "a", "skip_reason": "not found"}]}',
               'bad': '{"dependencies": [{"name": "a", "version": "1", "vulns": [{"id": "X-1", '
                      '"fix_versions": ["2"]}]}]}',
               'silent': ''}
    codes = {}
    for name, answer in answers.items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / 'python').symlink_to(sys.executable)
        (folder / 'pip-audit').write_text(f"#!/bin/sh\necho '{answer}'\n")
        (folder / 'pip-audit').chmod(0o755)
        codes[name] = subprocess.run([folder / 'python', ROOT / '.ci' / 'audit.py'], check=False,
                                     capture_output=True).returncode
    assert codes == {'clean': 0, 'unknown': 3, 'bad': 1, 'silent': 3}
