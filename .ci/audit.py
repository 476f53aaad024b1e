"""
Ask pip-audit for known vulnerabilities in the packages that it is installed with.

Exit code 0: all packages were audited and none has any; 1: some have; 3: not all could be audited,
which is no good news. pip-audit itself takes a package that its service does not know for clean.
"""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys

OURS = 'djet-ros'


def main() -> int:
    answer = subprocess.run(
        [Path(sys.executable).with_name('pip-audit'), '--format', 'json', '--progress-spinner',
         'off'], capture_output=True, text=True, check=False)
    try:
        packages = json.loads(answer.stdout)['dependencies']
    except (KeyError, ValueError):
        reason = (answer.stderr.strip().splitlines() or ['it said nothing'])[-1]
        print(f'audit: nothing could be audited: {reason}', file=sys.stderr)
        return 3
    others = [package for package in packages if package['name'].replace('_', '-') != OURS]
    for package in others:
        for found in package.get('vulns', ()):
            fixed = ', '.join(found['fix_versions']) or 'no version yet'
            print(f"{package['name']} {package['version']}: {found['id']}, fixed in {fixed}")
    if any(package.get('vulns') for package in others):
        return 1
    unknown = [package for package in others if 'skip_reason' in package]
    if unknown:
        print(f'audit: {len(unknown)} of {len(others)} packages could not be audited '
              f"({unknown[0]['skip_reason']}, ...); is a service reached that knows of "
              'vulnerabilities, and not only a mirror of packages?', file=sys.stderr)
        return 3
    print(f'audit: {len(others)} packages, none with a known vulnerability')
    return 0


if __name__ == '__main__':
    sys.exit(main())
