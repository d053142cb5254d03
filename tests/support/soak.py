"""Property tests with random examples, round after round until the clock: ``make soak``.

    python tests/support/soak.py MINUTES

Each round has a seed of its own, which is printed; a failing example is printed by Hypothesis,
and ``pytest --hypothesis-profile=soak --hypothesis-seed=SEED`` finds it again.  Exit code 1 as
soon as a round has failed.
"""

import secrets
import subprocess
import sys
import time

LEAST_MINUTES = 0.2  # a round that starts with less ends before its first test


def main(minutes: float) -> int:
    """Rounds until the minutes are over; the exit code."""
    until = time.monotonic() + 60 * minutes
    rounds = 0
    while (left := (until - time.monotonic()) / 60) > LEAST_MINUTES:
        rounds += 1
        seed = secrets.randbelow(2**32)
        print(f"soak: round {rounds}, seed {seed}, {left:.1f} minutes left", flush=True)
        command = [sys.executable, "-m", "pytest", "-q", "-rfE", "-m", "hypothesis"]
        command += ["-n", "auto", "--maxprocesses", "8", "--dist", "loadgroup"]
        command += ["--hypothesis-profile=soak", f"--hypothesis-seed={seed}", f"--minutes={left}"]
        if subprocess.run(command).returncode != 0:
            print(f"soak: round {rounds} failed; again: --hypothesis-seed={seed}")
            return 1
    print(f"soak: no failure in {rounds} rounds")
    return 0


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1])))
