"""The parameter schema: strict parsing, YAML round trip, flags and generated files."""

import argparse
from array import array
from dataclasses import replace
from pathlib import Path
import pickle

from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import flat, from_flat, with_values
from djet_ros.config.sections import Config, GRAPH_NAME, NODE_NAME, OdometryConfig, SECTIONS
from djet_ros.config.yaml_files import dump_yaml, load_yaml, why_unused
from djet_ros.core.estimator_config import EstimatorConfig, preset
from djet_ros.core.parameter import describe
from djet_ros.errors import DjetError
from djet_ros.live.parameters import FIXED_PARAMETERS, live_choices, tf_reason, with_live_values
from djet_ros.odometry.images import BadMessage
from djet_ros.recordings.frame_sequence import DamagedImage
from hypothesis import given, settings, strategies as st
import pytest

CONFIG = Path(__file__).parent.parent / 'config'
SHIPPED = CONFIG / 'vo.yaml'
GENERATED = {'vo.yaml': ('', 'estimator', 'odometry', 'ros'), 'slam.yaml': ('slam',)}


def written(tmp_path, text):
    path = tmp_path / 'some.yaml'
    path.write_text(text)
    return path


@pytest.mark.parametrize('name', GENERATED)
def test_shipped_yaml_is_up_to_date(name):
    expected = dump_yaml(Config(), GENERATED[name], preset_as_comments=True)
    assert (CONFIG / name).read_text() == expected, (
        f"regenerate config/{name}: python -c 'from djet_ros.config.sections import *; "
        'from djet_ros.config.yaml_files import *; print(dump_yaml(Config(), '
        f"{GENERATED[name]}, preset_as_comments=True), end=str())' > config/{name}")


def test_shipped_yaml_files_contain_every_section():
    shipped = [part for parts in GENERATED.values() for part in parts]
    assert sorted(shipped) == sorted(['', *SECTIONS])


def test_shipped_yaml_reads_as_the_defaults_without_fixing_the_preset():
    for name in GENERATED:
        assert load_yaml(CONFIG / name) == Config()
    assert '# method: "djet"' in SHIPPED.read_text()


@pytest.mark.parametrize('text', ['', '0', '1 1', '9 3', '0 65536', '-1 5', '0 1e3', '0 5 9',
                                  'low high', '0 ' + '9' * 5000])
def test_invalid_gray_range_is_refused(text):
    with pytest.raises(DjetError, match="odometry.gray_range is '.*'; give 'low high', whole"):
        from_flat({'odometry.gray_range': text})


def test_gray_range_may_have_a_comma():
    assert from_flat({'odometry.gray_range': '0, 4095'}).odometry.gray_limits() == (0, 4095)


def test_every_parameter_has_a_description():
    for item in flat(Config()).values():
        assert len(item.description.text) > 10, item.name


@pytest.mark.parametrize('config', [EstimatorConfig, OdometryConfig])
def test_help_on_a_configuration_tells_what_each_parameter_means(config):
    told = ' '.join(config.__doc__.split())
    assert told.startswith('Parameters of the ')
    for name, description in describe(config()).items():
        assert f' {name}: {" ".join(description.explained.split())}' in told


@pytest.mark.parametrize('as_comments', [False, True])
def test_yaml_round_trip(tmp_path, as_comments):
    config = from_flat({'preset': 'paper', 'estimator.window': 9, 'odometry.odom_frame': 'a: "b"',
                        'odometry.scale_value': 1e-6, 'ros.publish_tf': True,
                        'odometry.rectified': 'true'})
    path = written(tmp_path, dump_yaml(config, preset_as_comments=as_comments))
    assert load_yaml(path) == config


def test_plain_and_ros_layout_read_alike(tmp_path):
    plain = load_yaml(written(tmp_path, 'estimator: {method: rpe}\nros.qos_depth: 7\n'))
    ros = load_yaml(written(tmp_path, """
        /other: {ros__parameters: {speed: 1}}
        /**: {ros__parameters: {use_sim_time: true, estimator.method: djet}}
        /robot/vo_node: {ros__parameters: {estimator: {method: rpe}, ros: {qos_depth: 7}}}
        """))
    assert plain == ros == from_flat({'estimator.method': 'rpe', 'ros.qos_depth': 7})


def test_float_may_be_a_string_as_yaml_reads_an_exponent_without_a_point_as_one(tmp_path):
    for text in ('1e-3', "'0.001'"):
        config = load_yaml(written(tmp_path, f'odometry: {{scale_value: {text}}}'))
        assert config.odometry.scale_value == 1e-3


def test_explicit_values_override_the_preset():
    config = from_flat({'estimator.window': 11, 'preset': 'paper'})
    assert config.estimator == preset('paper', window=11)
    again = with_values(config, {'preset': 'best'})
    assert again.estimator == preset('best')


def test_int_is_accepted_for_float_but_not_float_for_int():
    config = from_flat({'odometry.max_gap': 2})
    assert config.odometry.max_gap == 2.0
    assert type(config.odometry.max_gap) is float
    with pytest.raises(DjetError, match=r'estimator\.window is 7\.0; it must be of type int'):
        from_flat({'estimator.window': 7.0})


@pytest.mark.parametrize('values', [
    "{imu_rotation: '0 0 0 1', gray_range: '0 4095'}",
    '{imu_rotation: [0.0, 0.0, 0.0, 1.0], gray_range: [0, 4095]}',
    '{imu_rotation: [0, 0, 0, 1], gray_range: [0, 4095]}',
    "{imu_rotation: '[0, 0, 0, 1]', gray_range: '[0, 4095]'}"])
def test_number_lists_may_be_strings_or_lists(tmp_path, values):
    config = load_yaml(written(tmp_path, f'odometry: {values}')).odometry
    assert config.imu_quaternion() == (0, 0, 0, 1)
    assert config.gray_limits() == (0, 4095)
    assert from_flat({'odometry.gray_range': array('q', [0, 4095])}).odometry == replace(
        OdometryConfig(), gray_range='0 4095')


@pytest.mark.parametrize('name, value, message', [
    ('odometry.gray_range', [0, True], 'of type str'),
    ('odometry.gray_range', [4095, 0], "gray_range is '4095 0'; give 'low high'"),
    ('odometry.imu_rotation', [1.0], 'give a quaternion'),
    ('odometry.odom_frame', [1, 2], 'of type str'),
    ('estimator.windw', 7, "did you mean 'estimator.window'"),
    ('max_gap', 1.0, "did you mean 'odometry.max_gap'"),
    ('loop_gaps', 1.0, "did you mean 'slam.loop_gap'"),
    ('estimator.loop_gap', 1.0, "did you mean 'slam.loop_gap'"),
    ('ros.path_perod', 1.0, "did you mean 'ros.path_period'"),
    ('slam.path_perod', 1.0, "did you mean 'slam.path_period'"),
    ('odomtry.zzz', 1, "did you mean the section 'odometry'"),
    ('odometry.zzz', 1, "unknown parameter 'odometry.zzz'$"),
    ('zzzzzz', 1, "unknown parameter 'zzzzzz'$"),
    ('nonsense', 1, "unknown parameter 'nonsense'$"),
    ('slam.links', 'two', r'slam\.links is .two.; it must be of type int'),
    ('slam.max_keyframes', 1, r'slam\.max_keyframes is 1; it must lie between'),
    ('estimator.window', 8, 'must be odd'),
    ('estimator.window', 700, 'between 3 and 15'),
    ('estimator.window', True, 'of type int'),
    ('estimator.method', 'sift', 'choose from djet'),
    ('preset', 'worst', 'choose from best'),
    ('odometry.max_gap', float('nan'), 'finite'),
    ('odometry.max_gap', 10 ** 400, 'finite'),
    ('odometry.max_gap', -1, 'between'),
    ('odometry.residual_k1', float('inf'), 'finite'),
    ('odometry.odom_frame', '', "^odometry.odom_frame is ''; name a frame"),
    ('odometry.odom_frame', '/', 'name a frame'),
    ('slam.map_frame', '', "^slam.map_frame is ''; name a frame"),
    ('odometry.residual_k1', -1001.0, 'between'),
    ('odometry.max_gap', None, 'of type float'),
    ('ros.publish_tf', 1, 'of type bool'),
])
def test_invalid_value_is_refused_in_one_line_with_its_name(name, value, message):
    with pytest.raises(DjetError, match=message) as caught:
        from_flat({name: value})
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('text', [
    'estimator: [1, 2]', '- 1', 'a: &a [*a]', 'x: {y: {z: 1}}', 'estimator: {window: {a: 1}}',
    '!!python/object/apply:os.system [true]', '{', '\x00', 'estimator: 2001-99-99',
    '[' * 5000, 'n: ' + '9' * 5000, 'odometry: {max_gap: 0x' + 'f' * 5000 + '}',
    '/**: {ros__parameters: 7}', 'text',
])
def test_invalid_parameter_file_is_refused_in_one_line(tmp_path, text):
    path = written(tmp_path, text)
    with pytest.raises(DjetError) as caught:
        load_yaml(path)
    assert str(caught.value).startswith(str(path))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(('text', 'message'), [
    ('odometry: [1, 2]', "'odometry' is a section and has no value; set its parameters, such as "
     'odometry.max_gap'),
    ('odometry: []', "'odometry' is a section"),
    ('odomtry: {max_gap: 2}', "unknown parameter 'odomtry.max_gap'; did you mean "
     "'odometry.max_gap'?"),
    ('odomtry:', "unknown parameter 'odomtry'; did you mean the section 'odometry'?"),
    ('vo_node: {ros__parameters: {odomtry: {max_gap: 2}}}', "did you mean 'odometry.max_gap'?"),
    ('/**: {odometry: {max_gap: 2}}', "unknown parameter '/**.odometry'; a file with names of "
     "nodes needs ros__parameters between them and 'odometry'"),
    ('odometry: {max_gap: {a: 1}}', "odometry.max_gap is {'a': 1}; it must be of type float")])
def test_mistaken_sections_are_named_with_what_was_meant(tmp_path, text, message):
    with pytest.raises(DjetError) as caught:
        load_yaml(written(tmp_path, text))
    assert message in str(caught.value)


def test_empty_sections_change_nothing(tmp_path):
    assert load_yaml(written(tmp_path, 'odometry:\nestimator: {}\n')) == Config()


def test_missing_huge_and_binary_files_are_refused(tmp_path):
    huge = written(tmp_path, '# ' + 'x' * 3_000_000)
    binary = tmp_path / 'binary.yaml'
    binary.write_bytes(bytes(range(128, 256)))
    for path in (tmp_path / 'absent.yaml', tmp_path, huge, binary):
        with pytest.raises(DjetError):
            load_yaml(path)


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(
    st.one_of(st.sampled_from([*flat(Config()), 'estimator', 'ros']), st.text(max_size=8)),
    st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
                 lambda inner: st.lists(inner, max_size=2), max_leaves=3), max_size=4))
def test_arbitrary_values_raise_only_djet_error(values):
    try:
        config = from_flat(values)
    except DjetError:
        return
    assert {name: flat(config)[name].value for name in values}.keys() == values.keys()


def test_flag_values_contain_only_given_flags():
    parser = argparse.ArgumentParser()
    add_flags(parser, ['preset', 'estimator.method', 'odometry.max_gap', 'ros.publish_tf'])
    args = parser.parse_args(['--method', 'rpe', '--max-gap', '3', '--publish-tf', 'true'])
    assert flag_values(args) == {
        'estimator.method': 'rpe', 'odometry.max_gap': 3.0, 'ros.publish_tf': True}
    assert '--max-gap' in parser.format_help()


def test_invalid_flag_value_is_named():
    parser = argparse.ArgumentParser()
    add_flags(parser, ['odometry.max_gap'])
    with pytest.raises(DjetError, match=r"odometry\.max_gap is 'soon'; it must be of type float"):
        flag_values(parser.parse_args(['--max-gap', 'soon']))


LAUGHS = 'a0: &a0 [ha, ha]\n' + ''.join(
    f'a{i}: &a{i} [{", ".join([f"*a{i - 1}"] * 10)}]\n' for i in range(1, 12))


@pytest.mark.parametrize('text', [
    LAUGHS + 'estimator: {window: *a11}',
    LAUGHS.replace('[', '{<<: [').replace(']', ']}').replace('[ha, ha]', '{ha: 1}')])
def test_yaml_aliases_that_expand_beyond_memory_are_refused(tmp_path, text):
    with pytest.raises(DjetError, match='its aliases expand to more than'):
        load_yaml(written(tmp_path, text))


def test_yaml_aliases_are_read(tmp_path):
    text = 'estimator: {window: &side 7}\nodometry: {max_lost: *side}'
    assert load_yaml(written(tmp_path, text)).odometry.max_lost == 7


def test_an_integer_that_would_take_minutes_is_refused(tmp_path):
    with pytest.raises(DjetError, match='it has an integer of 399999 characters'):
        load_yaml(written(tmp_path, f'a: {":".join(["1"] * 200_000)}'))


@pytest.mark.parametrize(('text', 'message'), [
    ('odometry: {max_lost: 7}\nros:\nodometry: {max_gap: 2}', "'odometry' .* lines 1 and 3"),
    ('odometry:\n  max_lost: 7\n  max_lost: 8', "'max_lost' .* lines 2 and 3"),
    ('{odometry: {max_lost: 7, max_lost: 8}}', "'max_lost' .* lines 1 and 1")])
def test_a_key_that_stands_twice_is_refused_with_its_lines(tmp_path, text, message):
    with pytest.raises(DjetError, match=f'is not valid YAML: {message}; join the two'):
        load_yaml(written(tmp_path, text))


@pytest.mark.parametrize('text', [
    'odometry.max_lost: 7\nodometry: {max_lost: 8}',
    '/**:\n  ros__parameters:\n    odometry: {max_lost: 8}\n    odometry.max_lost: 7'])
def test_a_parameter_nested_and_by_its_flat_name_is_refused(tmp_path, text):
    with pytest.raises(DjetError, match="'odometry.max_lost' is given twice"):
        load_yaml(written(tmp_path, text))


def test_the_later_of_two_matching_nodes_overrides_as_in_ros(tmp_path):
    text = ('/**: {ros__parameters: {odometry.max_lost: 7}}\n'
            'vo_node: {ros__parameters: {odometry: {max_lost: 8}}}')
    assert load_yaml(written(tmp_path, text)).odometry.max_lost == 8


def test_what_a_mapping_merges_may_be_overridden(tmp_path):
    text = ('odometry: &one {max_lost: 7, max_gap: 2}\n'
            'vo_node: {ros__parameters: {odometry: {<<: *one, max_gap: 3}}}')
    config = load_yaml(written(tmp_path, text)).odometry
    assert (config.max_lost, config.max_gap) == (7, 3)


@pytest.mark.parametrize('value', ['!!bool so', '!!int ""', '!!float ""', '!!timestamp soon',
                                   '\x01', '2001-01-01 00:00:00 +99:99'])
def test_values_that_crash_the_yaml_library_are_refused_in_one_line(tmp_path, value):
    with pytest.raises(DjetError, match='is not valid YAML') as caught:
        load_yaml(written(tmp_path, f'estimator: {{window: {value}}}'))
    assert str(caught.value).isprintable()


def test_error_messages_contain_no_control_characters():
    error = DjetError('no parameter \x1b[2J\n\u202e ' + 'x' * 5000)
    assert str(error).startswith('no parameter ?[2J ? xxx')
    assert len(str(error)) < 1100


@pytest.mark.parametrize('error', [
    DjetError('no parameter'), BadMessage('undecodable', 'JPEG image of 3 bytes is cut short'),
    DamagedImage(Path('a.png'), BadMessage('undecodable', 'PNG image of 500 bytes is cut short'))])
def test_an_error_of_a_worker_arrives_whole(error):
    received = pickle.loads(pickle.dumps(error))
    assert (type(received), str(received)) == (type(error), str(error))
    assert vars(received) == vars(error)


def test_offline_choices_are_not_available_live():
    scale = flat(Config())['odometry.scale']
    offered = [one for one in scale.description.choices if one != 'ground_truth']
    assert list(live_choices(scale)) == offered
    for value, reason in (('wheels', "is 'wheels'"),
                          ('ground_truth', "is 'ground_truth', which is available offline only")):
        with pytest.raises(DjetError) as error:
            with_live_values(Config(), {'odometry.scale': value})
        assert str(error.value) == f'odometry.scale {reason}; choose from {", ".join(offered)}'
    assert with_live_values(Config(), {'odometry.scale': 'speed'}).odometry.scale == 'speed'
    # every other choice is as good live as offline
    assert all(live_choices(item) == item.description.choices
               for item in flat(Config()).values() if item.name != 'odometry.scale')


def test_frames_and_axes_of_poses_are_read_only():
    of_poses = {name for name in flat(Config()) if name.startswith('odometry.')
                and name.endswith(('_frame', '_convention'))} - {'odometry.guess_frame'}
    assert len(of_poses) == 4
    assert of_poses < set(FIXED_PARAMETERS)
    assert set(FIXED_PARAMETERS) < flat(Config()).keys()


@pytest.mark.parametrize(('values', 'by'), [
    ({}, (False, False)), ({'guess_frame': 'odom_of_wheels'}, (False, False)),
    ({'guess': True}, (True, False)), ({'scale': 'guess'}, (True, False)),
    ({'guess': True, 'guess_frame': 'odom_of_wheels'}, (False, True)),
    ({'scale': 'guess', 'guess_frame': 'odom_of_wheels'}, (False, True))])
def test_guess_comes_from_its_topic_or_from_tf(values, by):
    config = from_flat({f'odometry.{name}': value for name, value in values.items()}).odometry
    assert (config.guess_by_topic, config.guess_by_tf) == by


@pytest.mark.parametrize(('values', 'why'), [
    ({}, ''),
    ({'base_frame': 'base_link'}, 'odometry.base_frame is base_link'),
    ({'imu': True}, 'odometry.imu is true without an odometry.imu_rotation'),
    ({'imu': True, 'imu_rotation': '0 0 0 1'}, ''),
    ({'guess': True}, 'odometry.guess is true'),
    ({'scale': 'guess'}, 'odometry.scale is guess'),
    ({'guess': True, 'guess_frame': 'odom_of_wheels'}, '')])
def test_tf_is_needed_for_mountings_that_are_not_parameters(values, why):
    config = from_flat({f'odometry.{name}': value for name, value in values.items()})
    assert tf_reason(config.odometry) == why


@pytest.mark.parametrize(('name', 'node', 'meant'), [
    ('/**', '/vo_node', True), ('/**', '/left/eye', True), ('/*', '/eye', True),
    ('/*', '/left/eye', False), ('vo_node', '/vo_node', True), ('/vo_node', '/vo_node', True),
    ('vo_node', '/left/vo_node', False), ('/left/vo_node', '/left/vo_node', True),
    ('/**/vo_node', '/left/vo_node', True), ('/*/vo_node', '/left/vo_node', True),
    ('vo_node', '/vo_node_2', False), ('vo.node', '/vo_node', False)])
def test_parameter_file_for_other_nodes_is_detected_by_ros_name_rules(
        tmp_path, name, node, meant):
    path = written(tmp_path, f"'{name}': {{ros__parameters: {{preset: paper}}}}")
    said = why_unused(path, node)
    assert said == '' if meant else said == (
        f"{path}: it has parameters for /{name.strip('/')} and none for {node}, so it is ignored; "
        "name the node in the file, or use '/**' for all nodes")


def test_parameter_file_may_be_for_several_nodes(tmp_path):
    path = written(tmp_path, """
        left: {vo_node: {ros__parameters: {preset: paper}}}
        other: {ros__parameters: {}}
    """)
    assert why_unused(path, '/left/vo_node') == why_unused(path, '/other') == ''
    assert 'has parameters for /left/vo_node, /other and none for' in why_unused(path, '/vo_node')
    assert 'has parameters for no node and none for' in why_unused(
        written(tmp_path, '{}'), '/vo_node')


def gap(path, *nodes):
    """Return max_gap as read from a file, offline or for some nodes."""
    return load_yaml(path, **({'nodes': nodes} if nodes else {})).odometry.max_gap


@pytest.mark.parametrize('text', [
    '/left/vo_node: {ros__parameters: {odometry.max_gap: 3}}',
    'left: {vo_node: {ros__parameters: {odometry: {max_gap: 3}}}}',
    '/left: {vo_node: {ros__parameters: {odometry: {max_gap: 3}}}}'])
def test_parameter_file_with_a_namespace_is_read_offline_and_by_that_node_only(
        tmp_path, text):
    path = written(tmp_path, text)
    assert gap(path) == gap(path, '/left/vo_node') == 3
    for other in ('/right/vo_node', '/vo_node', '/left/eye'):
        with pytest.raises(DjetError) as error:
            gap(path, other)
        assert str(error.value) == (
            f'{path}: it has parameters for /left/vo_node and none for {other}, so it is ignored; '
            "name the node in the file, or use '/**' for all nodes")


def test_parameter_file_of_two_cameras_is_ambiguous_offline(tmp_path):
    path = written(tmp_path, """
        /**: {ros__parameters: {odometry: {max_gap: 1.5, max_lost: 9}}}
        /left/vo_node: {ros__parameters: {odometry: {max_gap: 3}}}
        right: {vo_node: {ros__parameters: {odometry: {max_gap: 7}}}}
    """)
    assert (gap(path, '/left/vo_node'), gap(path, '/right/vo_node')) == (3, 7)
    assert gap(path, '/rear/vo_node') == 1.5
    assert load_yaml(path, nodes=['/left/vo_node']).odometry.max_lost == 9
    with pytest.raises(DjetError, match='it has parameters for /left/vo_node and /right/vo_node, '
                                        'and only one of them can be used; give a file with'):
        load_yaml(path)
    path.write_text(f'{path.read_text().rstrip()}\n'
                    '        vo_node: {ros__parameters: {preset: fast}}')
    assert gap(path) == 1.5
    assert load_yaml(path).preset == 'fast'


def test_parameter_file_for_other_nodes_is_refused(tmp_path):
    for name in ('left_vo', 'pose_graph_node', '/*/eye'):
        path = written(tmp_path, f"'{name}': {{ros__parameters: {{slam.loop_votes: 7}}}}")
        with pytest.raises(DjetError, match='none for /vo_node, so it is ignored; ') as one:
            load_yaml(path)
        assert str(one.value).startswith(
            f'{path}: it has parameters for /{name.strip("/")} and none ')


def test_offline_slam_reads_parameters_of_both_nodes(tmp_path):
    path = written(tmp_path, """
        pose_graph_node: {ros__parameters: {slam: {loop_votes: 7}, estimator: {window: 5}}}
    """)
    both = (NODE_NAME, GRAPH_NAME)
    assert load_yaml(path, nodes=both) == from_flat({'slam.loop_votes': 7})
    path.write_text(path.read_text() + """
        vo_node: {ros__parameters: {odometry: {max_gap: 3}}}
    """)
    assert load_yaml(path, nodes=both) == from_flat({'slam.loop_votes': 7, 'odometry.max_gap': 3})
    assert load_yaml(path) == from_flat({'odometry.max_gap': 3})
