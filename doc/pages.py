"""
Generates the blocks between ``generated`` marks in README.md and doc/*.md from the data in doc/.

    python doc/pages.py           # write the pages
    python doc/pages.py --check   # name the pages that are out of date; exit code 1
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import json
from pathlib import Path
import re
from statistics import median
import sys
import textwrap
from typing import Any

from djet_ros.lab import peers
from djet_ros.lab.ablation import ON_PLACES, WEIGHED
from djet_ros.lab.chains import CHAINS
from djet_ros.lab.methods import TITLES
from djet_ros.lab.published import TABLE_1
from djet_ros.lab.scenes import SCENES
from djet_ros.live.parameters import FIXED_PARAMETERS, SHARED_PARAMETERS
from djet_ros.odometry.images import ENCODINGS
import yaml

ROOT = Path(__file__).resolve().parents[1]
DOC = ROOT / 'doc'
PAGES = (ROOT / 'README.md', *sorted(DOC.glob('*.md')))
BLOCK = re.compile(r'(?<=<!-- generated: )([\w -]+)( -->\n).*?(?=<!-- end -->)', re.DOTALL)
RESULTS = DOC / 'results.json'

PRINTED_HAMMING = ('djet', 'rpe', 'five_point')
OURS = ('djet', 'rpe', 'pjet', 'five_point')
# Columns of the table in the README.
SHOWN = ('djet', 'rpe', 'poselib', 'sift_poselib', 'klt_poselib')
DATA_SETS = {'kitti': 'KITTI', 'tum': 'TUM', 'tartanair': 'TartanAir'}
DIGITS = {'rotation': 4, 'direction': 3}
# Columns for a replayed drive; name of the replay without a source of metric scale.
OF_REPLAY = ('ATE rmse, m', 'scale, end over start', 't_rel, %', 'r_rel, ° per 100 m')
ALONE = 'images alone'
# Degrees; no ratio is given of two errors below this.
EQUAL = 0.001
# Ratios beyond this are given as "> MOST".
MOST = 100
# Triplets needed for a 95th percentile; of fewer it is the maximum.
ENOUGH = 20
# Scenes without translation, which have no direction to compare.
WITHOUT_TRANSLATION = {name for name, entry in SCENES.items() if not entry.parallax}


def main(check: bool) -> int:
    results = json.loads(RESULTS.read_text('utf-8'))
    stale = []
    for page in PAGES:
        text = page.read_text('utf-8')
        filled = BLOCK.sub(lambda found: found[1] + found[2] + BLOCKS[found[1]](results), text)
        if filled != text:
            stale.append(page.relative_to(ROOT).as_posix())
            if not check:
                page.write_text(filled, 'utf-8')
    if check and stale:
        print(f'out of date, run make pages: {", ".join(stale)}', file=sys.stderr)
        return 1
    return 0


def data(name: str) -> Any:
    return yaml.safe_load((DOC / f'{name}.yaml').read_text('utf-8'))


def paragraph(text: str) -> str:
    return textwrap.fill(text, 110, break_long_words=False, break_on_hyphens=False) + '\n\n'


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ['---'] * len(header), *rows]
    return ''.join(f'| {" | ".join(line)} |\n' for line in lines)


# Tables from the YAML files


def recorded(name: str) -> Callable[[Any], str]:
    def block(_: Any) -> str:
        one = data('recorded')[name]
        return (paragraph(f'Measured with version {one["version"]}. {one["how"]}')
                + table(one['header'], one['rows']))
    return block


def reports(_: Any) -> str:
    return table(('report', 'behaviour', 'tests'), (
        (one['report'], one['answer'], tests(one['tests'])) for one in data('reports')))


def promises(_: Any) -> str:
    return table(('guarantee', 'tests'), (
        (one['promise'], ' '.join(filter(None, (tests(one['tests']), one.get('also')))))
        for one in data('promises')))


def tests(names: Iterable[str]) -> str:
    return ', '.join(f'`{name}`' for name in names)


def hard_images(_: Any) -> str:
    return table(('images', 'outcome'), (
        (one['images'], hard_outcome(one)) for one in data('bounds')['hard_images']))


def hard_outcome(one: dict[str, Any]) -> str:
    text = ' or '.join(f'`{status}`' for status in one['statuses'])
    if 'rotation' in one:
        text += f'; below {one["rotation"]:g}°'
    if 'direction' in one:
        text += f' / {one["direction"]:g}°'
    return text + (f': {one["note"]}' if 'note' in one else '')


def covariance_bound(_: Any) -> str:
    bound = data('bounds')['normalised_squared_error']
    return (f'* A test requires its mean over these scenes to lie between {bound["least"]:g} and '
            f'{bound["most"]:g}.\n')


def dependencies(_: Any) -> str:
    return table(('package', 'versions', 'what for'), (
        (f'`{one["name"]}`' + (f', extra `{one["extra"]}`' if 'extra' in one else ''),
         one['versions'], one['reason']) for one in data('dependencies')))


def short_dependencies(_: Any) -> str:
    return table(('package', 'what for'), (
        (f'`{one["name"]}`' + (f' (`{one["extra"]}`)' if 'extra' in one else ''),
         one.get('short', one['reason'])) for one in data('dependencies')))


def complaints(_: Any) -> str:
    return table(('summary', 'level', 'cause'), (
        (f'`{one["name"]}`', one['level'], one['seen']) for one in data('complaints')))


def fixed(_: Any) -> str:
    return named(FIXED_PARAMETERS)


def shared(_: Any) -> str:
    return named(['estimator.*', *SHARED_PARAMETERS])


def encodings(_: Any) -> str:
    return named(ENCODINGS)


def named(names: Iterable[str]) -> str:
    return paragraph(', '.join(f'`{name}`' for name in names) + '.')


def rooms(_: Any) -> str:
    lines = []
    for level in data('rooms'):
        lines += [f'    {name:<11} {text}' for name, text in level.items()]
    return '```\ndjet_ros/\n' + '\n'.join(lines) + '\n```\n'


# Measured by doc/measure.py


def summary(results: Any) -> str:
    """Return the table of the README: mean errors and failures over all pairs."""
    shown = [name for name in SHOWN if name in methods_of(results)]
    rows = [(name, str(pairs(part)), *(cell(part, method, 'mean') for method in shown))
            for name, part in sequences(results) if name not in WITHOUT_TRANSLATION]
    return (paragraph('Mean errors in degrees, rotation / translation direction, over the pairs '
                      'with an estimate; failed pairs in brackets. '
                      f'{conditions(results)}')
            + table(('', 'pairs', *(TITLES[name] for name in shown)), rows))


def conditions(results: Any) -> str:
    settings = results['settings']
    seeds = len(settings['seeds'])
    return (f'Rendered scenes: the first {settings["frames"]} frames of {seeds} '
            f'{"seed" if seeds == 1 else "seeds"}, exact ground truth. Each pair is estimated '
            'independently.')


def measured_with(results: Any) -> str:
    settings = results['settings']
    words = ['make results', f'FRAMES={settings["frames"]}',
             f'SEEDS={",".join(map(str, settings["seeds"]))}']
    if settings['real_frames']:
        words.append(f'REAL_FRAMES={settings["real_frames"]}')
    versions = ', '.join(f'{name} {number}' for name, number in results['versions'].items())
    real = settings['real_frames']
    state = '' if results['complete'] else '**This run is not complete.** '
    return f'```sh\n{" ".join(words)}\n```\n\n' + paragraph(
        f'{state}{conditions(results)} Real sequences: '
        f'{f"up to {real} frames" if real else "all frames available"}. '
        f'Measured on {results["cores"]} cores with {versions}.')


def compared(results: Any) -> str:
    return ''.join(f'### {name}\n\n{comparison(part)}\n' for name, part in sequences(results))


def comparison(part: Any) -> str:
    """Return the table of one sequence by method; D-JET, preset best, is the first."""
    seeds = len(part['seeds'])
    head = f'{pairs(part)} pairs' + (f' of {seeds} seeds' if seeds > 1 else '')
    worst = ('worst seed',) if seeds > 1 else ()
    header = ('method', 'preset', 'estimated', 'rotation: mean', 'median', '95 %', *worst,
              'direction: mean', 'median', '95 %', *worst, 'failed', 'of these `OK`', 'time')
    rows, unit = [], part['methods'][0]['ms']
    for one in part['methods']:
        figures = []
        for what, digits in DIGITS.items():
            values = [one[what][name] for name in ('mean', 'median', 'p95')]
            values += [worst_seed(one, what)] if worst else []
            figures += [number(value, digits) for value in values]
        rows.append((TITLES[one['method']], one['preset'] if one['method'] in OURS else '–',
                     estimated(one), *figures, str(one['failed']), str(one['sure']),
                     f'{one["ms"] / unit:.2f}'))
    return f'{head}.\n\n{table(header, rows)}'


def estimated(one: Any) -> str:
    """Return the numbers of pairs with an estimated rotation and with an estimated direction."""
    return ' / '.join(number(one[what].get('told'), 0) for what in DIGITS)


def worst_seed(one: Any, what: str) -> float | None:
    return max((seed[what] for seed in one['by_seed'] if seed[what] is not None), default=None)


def against(other: str, presets: Sequence[str]) -> Callable[[Any], str]:
    """Return the block that compares D-JET with another method of ours, by sequence."""
    def block(results: Any) -> str:
        rows = [compared_row(name, part, other, preset)
                for preset in presets for name, part in sequences(results)]
        behind = [f'{row[0]} (`{row[1]}`)' for row in rows if '**' in ''.join(row)]
        known = all('against' in part for _, part in sequences(results))
        return paragraph(
            f'Error ratios D-JET / {TITLES[other]} on the same matches, over the pairs that both '
            'estimated; below 1 D-JET is better, above 1 (bold) worse. '
            + (f'D-JET is worse in at least one figure on: {", ".join(behind)}.' if behind
               else 'D-JET is worse in none.' if known else '')
        ) + table(('', 'preset', 'both estimated', 'rotation: mean', 'median', 'direction: mean',
                   'median', f'failed, D-JET / {TITLES[other]}'), rows)
    return block


def compared_row(name: str, part: Any, other: str, preset: str) -> tuple[str, ...]:
    comparison = next((one for one in part.get('against', ())
                       if (one['other'], one['preset']) == (other, preset)), None)
    figures = ['–'] * 5 if comparison is None else [
        estimated(comparison),
        *(ratio(*comparison[what][kind]) for what in DIGITS for kind in ('mean', 'median'))]
    return (name, preset, *figures,
            failures(find(part, 'djet', preset), find(part, other, preset)))


def failures(ours: Any, theirs: Any) -> str:
    text = f'{ours["failed"]} / {theirs["failed"]}'
    return f'**{text}**' if ours['failed'] > theirs['failed'] else text


def ratio(ours: float | None, theirs: float | None) -> str:
    """Return the ratio of two errors in degrees; none where both are below EQUAL."""
    if ours is None or theirs is None or max(ours, theirs) < EQUAL:
        return '–'
    # A method that reports a standstill as identity has no error at all: the ratio is unbounded.
    text = f'{ours / theirs:.2f}' if ours < MOST * theirs else f'> {MOST}'
    return f'**{text}**' if ours > theirs and text != '1.00' else text


def table_1(results: Any) -> str:
    """Return the paper's Table 1 next to the results of the preset `paper`."""
    rows, starts = [], []
    for name, part in sequences(results):
        if name not in TABLE_1:
            continue
        printed = {row.method: row for row in TABLE_1[name]}
        measured = {method: find(part, method, 'paper') or {} for method in OURS}
        rows += [(name, f'here, {pairs(part)} pairs',
                  *(number(one.get('rotation', {}).get('mean')) for one in measured.values()),
                  *(number(one.get('direction', {}).get('mean')) for one in measured.values()),
                  *(number(measured[method].get('hamming'), 2) for method in PRINTED_HAMMING)),
                 (name, 'the paper', *(number(printed[method].rotation_deg) for method in OURS),
                  *(number(printed[method].translation_deg) for method in OURS),
                  *(number(printed[method].hamming, 2) for method in PRINTED_HAMMING))]
        if measured['five_point']:
            starts.append(f'{pair_of(measured["five_point"], "mean")} here and '
                          f'{printed["five_point"].rotation_deg:.3f} / '
                          f'{printed["five_point"].translation_deg:.3f} there on {name}')
    said = ("The paper's Table 1 (whole sequences, units as printed: degrees) next to the preset "
            '`paper` on their first pairs: mean errors, and mean Hamming distances in bits.')
    if starts:
        said += f' Already the initial pose, 5-P, differs: {", ".join(starts)}.'
    titles = [TITLES[method] for method in OURS]
    return paragraph(said) + table(
        ('', '', f'rotation: {titles[0]}', *titles[1:], f'translation: {titles[0]}', *titles[1:],
         f'Hamming: {titles[0]}', *(TITLES[method] for method in PRINTED_HAMMING[1:])), rows)


def peer_settings(_: Any) -> str:
    """Return the settings of the methods compared with, as the code has them."""
    chains = ''.join(paragraph(
        f'{TITLES[name]}: {first_line(chain.detect)} {first_line(chain.match)}')
        for name, chain in CHAINS.items())
    return (paragraph(
        'Settings of the other methods are fixed, and chosen for small errors over all scenes; '
        'in single scenes others are better. PL is PoseLib. RANSAC and MAGSAC++ are '
        f'`findEssentialMat` with a threshold of {peers.RANSAC_THRESHOLD:g} px, as our matches '
        f'are accurate (the usual 1 px doubles the error), a confidence of {peers.CONFIDENCE:g}, '
        f'and `recoverPose` with `distanceThresh={peers.FARTHEST:g}`: its default ignores points '
        'beyond 50 baselines in the chirality check, which after a small step of a hand-held '
        'camera is all of them. PoseLib is its LO-RANSAC with a threshold of '
        f'{peers.POSELIB_THRESHOLD:g} px, at least {peers.MIN_ITERATIONS} iterations (its default '
        'of 1000 takes six times as long for the same errors), and refinement with a Cauchy loss '
        f'of scale {peers.LOSS_SCALE:g} px; its default, half the threshold, leaves larger '
        'errors. The same holds with SIFT and KLT. `djet_ros/lab/chains.py` says what was '
        'tried.')
        + chains)


def first_line(function: Callable[..., Any]) -> str:
    return str(function.__doc__).strip().split('\n')[0]


def odometry(results: Any) -> str:
    rows = []
    for name, part in sequences(results):
        one = part['odometry']
        rows.append((name, str(one['pairs']), estimated(one),
                     *(number(one[what][kind], DIGITS[what])
                       for what in ('rotation', 'direction')
                       for kind in ('mean', 'median', 'max')),
                     str(one['failed']), str(one['sure'])))
    return table(('', 'pairs', 'estimated', 'rotation: mean', 'median', 'max', 'direction: mean',
                  'median', 'max', 'failed', 'of these `OK`'), rows)


def drift(results: Any) -> str:
    """Return the tables of whole drives: chained pairs by method, and replays."""
    drives = [(known_as(name.removeprefix('drive ')), part)
              for name, part in results['parts'].items() if name.startswith('drive ')]
    if not drives:
        return 'No drive of over 100 m was measured.\n'
    chained = [(name, TITLES[one['method']], *(number(one['drift'][what]) for what in (
        'translation_percent', 'rotation_deg_per_100m')))
        for name, part in drives for one in part['chained']]
    replays = [(f'{name}, {how}', *replay(one)) for name, part in drives
               for how, one in [*part['replays'].items(), *(
                   (f'{how}, distortion corrected', one)
                   for how, one in part.get('lens', {'replays': {}})['replays'].items())]]
    whole = ', '.join(f'{name} ({part["frames"]} frames, {part["length"]:.0f} m)'
                      for name, part in drives)
    return (paragraph(f'{whole}. Independent pairs chained, with the translation lengths of the '
                      'ground truth:')
            + table(('', 'method', 't_rel, %', 'r_rel, ° per 100 m'), chained) + '\n'
            + paragraph('`djet replay`, with its own translation lengths. ATE after alignment, '
                        f'with scale unless it is metric. {medians(drives[0][1])}:')
            + table(('', *OF_REPLAY), replays))


def lens(results: Any) -> str:
    """Return the tables of drives replayed with more and less distortion than was found."""
    text = ''
    for name, part in results['parts'].items():
        if 'lens' not in part:
            continue
        found = part['lens']
        k1, sigma = found['k1'], found['sigma']
        runs = {0.0: part['replays'][ALONE], k1: found['replays'][ALONE],
                **{k1 + int(off) * sigma: one for off, one in found['beside'].items()}}
        text += (paragraph(f"{known_as(name.removeprefix('drive '))}, {part['frames']} frames, "
                           f'{ALONE}; `djet lens` finds k1 = {k1:.4f} ± {sigma:.4f}. '
                           f'{medians(part)}:')
                 + table(('k1', *OF_REPLAY), ((f'{value:.4f}', *replay(runs[value]))
                                              for value in sorted(runs))))
    return text or 'No drive shows a distortion that is worth correcting.\n'


def medians(part: Any) -> str:
    """Return what the figures of a drive's replays are."""
    count = max(map(len, part['replays'].values()), default=0)
    return f'Medians (worst) of {count} replays, which begin at the first {count} frames'


def replay(ones: Any) -> tuple[str, ...]:
    """Return the figures of replays, medians and the worst, in the order of OF_REPLAY."""
    return tuple(
        f'{number(median(values), places)} '
        f'({number(max(values, key=lambda value: abs(value - best)), places)})'
        for what, name, best, places in (
            ('positions', 'rmse_m', 0.0, 2), ('positions', 'scale_change', 1.0, 3),
            ('drift', 'translation_percent', 0.0, 2), ('drift', 'rotation_deg_per_100m', 0.0, 3))
        for values in [[one[what][name] for one in ones]])


def surprise(results: Any) -> str:
    rows = []
    for name, part in sequences(results):
        one = part['odometry']['surprise']
        if one['pairs']:
            digits = 1 if max(one['mean'], one['median']) < 100 else 0
            rows.append((name, str(one['pairs']), number(one['mean'], digits),
                         number(one['median'], digits), str(one['beyond'])))
    return table(('', 'pairs', 'NEES: mean (5 expected)', 'median (4.4 expected)',
                  'beyond the 99.9 % bound'), rows)


def closure(results: Any) -> str:
    rows = []
    for name, part in sequences(results):
        for method, one in part['closure'].items():
            if not one['triangles']:
                continue
            rows.append((name, TITLES[method], number(one['median_deg']),
                         number(one['p95_deg'] if one['triangles'] >= ENOUGH else None),
                         number(one['claimed_median_deg']),
                         number(one['normalised_square_mean'], 1),
                         number(one['error_median_deg']),
                         f'{one["triangles"]:.0f} of {one["triangles"] + one["without"]:.0f}'))
    return table(('', 'method', 'closure error, median', '95 %', 'predicted',
                  'NEES (3 expected)', 'error against ground truth, median', 'triplets'), rows)


def ablation(results: Any) -> str:
    part = results['parts'].get('ablation')
    if part is None:
        return 'Not measured yet.\n'
    return (paragraph(f'Over {part["variants"][0]["pairs"]} pairs: the first {part["frames"]} '
                      f'frames of {", ".join(part["of"])}, {len(part["seeds"])} seeds each. '
                      'Ratios are over pairs that both estimated, with the 95 % interval of a '
                      'paired bootstrap over pairs.')
            + table(VARIANTS, map(variant, part['variants'])) + '\n' + paragraph(verdict(part)))


VARIANTS = ('method', 'change', 'mean (failed)', 'median', 'rotation over `best`: mean', 'median',
            'direction over `best`: mean', 'median')


def variant(one: Any) -> tuple[str, ...]:
    """Return a row of the ablation."""
    return (TITLES[one['method']], one['change'] or '`best`', cell_of(one, 'mean'),
            pair_of(one, 'median'), *(interval(one, what, kind) for what in DIGITS
                                      for kind in ('mean', 'median')))


def interval(one: Any, what: str, kind: str) -> str:
    value, least, most = one['ratio'][what][kind] if 'ratio' in one else (None,) * 3
    return '–' if value is None else f'{value:.2f} ({least:.2f} to {most:.2f})'


def verdict(part: Any) -> str:
    """Return which changes of D-JET make a significant difference of the means."""
    changed = [one for one in part['variants'] if one['method'] == 'djet' and one['change']]
    if not all('ratio' in one for one in changed):
        return 'Significance of these differences was not measured yet.'
    by_verdict: dict[str, list[str]] = {}
    for one in changed:
        by_verdict.setdefault(judged(one['ratio']), []).append(one['change'])
    return 'Significance of the means of both errors. ' + ' '.join(
        f'{word}: {"; ".join(by_verdict[word])}.' for word in JUDGED if word in by_verdict)


JUDGED = (
    'Worse in both', 'Worse in one, not significant in the other', 'Better in both',
    'Better in one, not significant in the other', 'Better in one, worse in the other',
    'Not significant (both intervals contain 1)')


def judged(ratio: Any) -> str:
    """Return which of JUDGED holds, by the intervals of both ratios."""
    known = [by_kind['mean'] for by_kind in ratio.values() if None not in by_kind['mean']]
    worse, better = (sum(least > 1 for _, least, _ in known),
                     sum(most < 1 for _, _, most in known))
    if worse and better:
        return JUDGED[4]
    if worse or better:
        return JUDGED[(0 if worse else 2) + (worse + better < len(ratio))]
    return JUDGED[5]


def joined(results: Any) -> str:
    """Return the comparison of surfaces and photometric alignment, together and alone."""
    part = results['parts'].get('ablation')
    variants = (('djet', ''), ('djet', 'surfaces alone'), ('rpe', ON_PLACES), ('rpe', WEIGHED),
                ('rpe', ''))
    found = {(one['method'], one['change']): one for one in part['variants']} if part else {}
    if ('rpe', WEIGHED) not in found:
        return 'Surfaces and photometric alignment alone were not measured yet.\n'
    return (paragraph(f'On {found["djet", ""]["pairs"]} rendered pairs, those of the "Ablation" '
                      'below:') + table(VARIANTS, (variant(found[key]) for key in variants)))


def speed(results: Any) -> str:
    part = results['parts'].get('speed')
    if part is None:
        return 'Not measured yet.\n'
    sources = part['sources']
    first = next(iter(sources.values()))
    runs = [run for one in sources.values() for run in (one, one['all_cores'])]
    rows = [("time relative to OpenCV's pipeline",
             *(f'{one["pipeline_over_opencv"]:.2f}' for one in runs)),
            ('the same, preset `fast`', *(f'{one["fast_over_opencv"]:.2f}' for one in runs)),
            ('pairs per second', *(f'{one["pairs_per_second"]:.1f}' for one in runs)),
            ('the same, preset `fast`', *(f'{one["fast_pairs_per_second"]:.1f}' for one in runs)),
            *((f'{stage}, ms', *(f'{one["stages_ms"].get(stage, 0.0):.1f}' for one in runs))
              for stage in first['stages_ms'])]
    columns = [f'{known_as(of)}, {cores}'
               for of in sources for cores in ('one thread', 'all cores')]
    growth = [(f'{name} {key}', f'{value:.1f}')
              for name, by in (('matches:', 'djet_ms_by_points'), ('window:', 'djet_ms_by_window'))
              for key, value in first[by].items()]
    bag = ('; the bag holds raw images, as a camera driver sends them' if len(sources) > 1
           else '')
    return (paragraph(f'{first["pairs"]} pairs, from recording to pose. Files are decoded{bag}.')
            + table(('', *columns), rows) + '\n'
            + paragraph('The D-JET stage (surfaces and optimisation), in ms, by number of matches '
                        f'and by window side. {kernel(first)}A frame in memory takes '
                        f'{first["bytes_per_frame"] / 1e6:.1f} MB.')
            + table(('', 'ms'), growth))


def kernel(part: Any) -> str:
    """Return the cost of a surface sample, if the number of its tests was measured."""
    if 'kernel_tests' not in part:
        return ''
    return (f'A surface sample ({part["kernel_tests"]} tests) costs '
            f'1/{part["kernel_speedup_over_cv2"]:.0f} of a descriptor (256 tests) by '
            '`cv2.ORB.compute`, not counting the creation of its keypoints. ')


def sequences(results: Any) -> list[tuple[str, Any]]:
    return [(known_as(name), part) for name, part in results['parts'].items()
            if 'methods' in part]


def known_as(name: str) -> str:
    """Return the usual name of a sequence."""
    data_set, _, sequence = name.partition(' ')
    return f'{DATA_SETS.get(data_set, data_set)} {sequence.removeprefix("rgbd_dataset_")}'.strip()


def methods_of(results: Any) -> set[str]:
    return {one['method'] for _, part in sequences(results) for one in part['methods']}


def pairs(part: Any) -> int:
    count: int = part['methods'][0]['pairs']
    return count


def find(part: Any, method: str, preset: str = 'best') -> Any:
    return next((one for one in part['methods']
                 if (one['method'], one['preset']) == (method, preset)), None)


def cell(part: Any, method: str, kind: str) -> str:
    one = find(part, method)
    return '–' if one is None else cell_of(one, kind)


def cell_of(one: Any, kind: str) -> str:
    return pair_of(one, kind) + (f' ({one["failed"]})' if one['failed'] else '')


def pair_of(one: Any, kind: str) -> str:
    return f'{number(one["rotation"][kind], 4)} / {number(one["direction"][kind])}'


def number(value: float | None, digits: int = 3) -> str:
    return '–' if value is None else f'{value:.{digits}f}'


BLOCKS: dict[str, Callable[[Any], str]] = {
    'summary': summary, 'short dependencies': short_dependencies, 'dependencies': dependencies,
    'rooms': rooms, 'complaints': complaints, 'fixed parameters': fixed,
    'shared parameters': shared, 'encodings': encodings, 'reports': reports,
    'promises': promises, 'hard images': hard_images,
    'covariance bound': covariance_bound,
    'measured with': measured_with, 'compared': compared, 'table 1': table_1,
    'peers': peer_settings,
    'against rpe': against('rpe', ('best', 'paper')), 'against pjet': against('pjet', ('best',)),
    'odometry': odometry, 'drift': drift, 'lens': lens, 'surprise': surprise, 'closure': closure,
    'ablation': ablation, 'joined': joined, 'speed': speed,
    **{name: recorded(name) for name in (
        'node', 'dds', 'soak', 'outvoted', 'links', 'loops', 'live loops', 'camera height',
        'short ways', 'coverage')},
}


if __name__ == '__main__':
    sys.exit(main('--check' in sys.argv[1:]))
