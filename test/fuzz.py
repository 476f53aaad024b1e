"""
Coverage-guided fuzzing of all readers of foreign data, for a bounded time.

    python test/fuzz.py [--seconds N] [TARGET ...]     each target in turn, N seconds each
    python test/fuzz.py --input FILE TARGET            one input again, with its traceback

Needs atheris (``pip install '.[fuzz]'``). What was learnt stays in fuzz/TARGET/ for the
next run, and an input that breaks something is kept beside it. The exit code is 1 if one does.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import re
import resource
import subprocess
import sys

ROOT = Path(__file__).resolve().parents[1]
CORPUS = ROOT / 'fuzz'
# Bytes that a target may take beyond what the program has to begin with.
ROOM = 1 << 30
SLOWEST_INPUT_S = 20
LONGEST_INPUT = 20_000


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('targets', nargs='*', metavar='TARGET')
    parser.add_argument('--seconds', type=int, default=30, help='for each target (%(default)s)')
    parser.add_argument('--input', type=Path, metavar='FILE')
    parser.add_argument('--inside', action='store_true', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.inside:
        return fuzz(args.targets[0], args.seconds)
    import fuzz_targets
    unknown = set(args.targets) - set(fuzz_targets.TARGETS)
    if unknown:
        parser.error(f'no target {min(unknown)}; there are {", ".join(fuzz_targets.TARGETS)}')
    if args.input:
        fuzz_targets.TARGETS[args.targets[0]].run(args.input.read_bytes())
        return 0
    names = args.targets or list(fuzz_targets.TARGETS)
    held = [run(name, args.seconds) for name in names]
    return 0 if all(held) else 1


def run(name: str, seconds: int) -> bool:
    """Fuzz one target in another process; return whether it passed."""
    CORPUS.mkdir(exist_ok=True)
    log = CORPUS / f'{name}.log'
    with log.open('w') as output:
        code = subprocess.run([sys.executable, __file__, '--inside', '--seconds', str(seconds),
                               name], stdout=output, stderr=output, check=False).returncode
    text = log.read_text(errors='replace')
    inputs = re.findall(r'^#(\d+)', text, re.MULTILINE)
    broke = re.findall(r'Test unit written to (\S+)', text)
    print(f'{name:18} {inputs[-1] if inputs else 0:>9} inputs  '
          f'{"held" if code == 0 else f"BROKE (exit code {code}): {log}"}', flush=True)
    for path in broke:
        print(f'    again: python test/fuzz.py --input {path} {name}', flush=True)
    return code == 0


def fuzz(name: str, seconds: int) -> int:
    """Let atheris generate inputs, in this process, which it ends."""
    import atheris
    with atheris.instrument_imports(include=['djet_ros', 'rosbags', 'yaml']):
        import fuzz_targets
    target = fuzz_targets.TARGETS[name]
    corpus = CORPUS / name
    corpus.mkdir(exist_ok=True)
    for number, data in enumerate(target.seeds()):
        (corpus / f'seed-{number}').write_bytes(data)
        target.run(data)
    used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
    atheris.Setup([sys.argv[0], str(corpus), f'-max_total_time={seconds}',
                   f'-timeout={SLOWEST_INPUT_S}', f'-max_len={LONGEST_INPUT}', '-rss_limit_mb=0',
                   f'-artifact_prefix={CORPUS}/{name}-'], target.run)
    atheris.Fuzz()
    return 0


if __name__ == '__main__':
    sys.exit(main())
