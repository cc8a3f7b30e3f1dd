"""`python -m evaluate.envelope`: compute and verify the envelope."""

import sys

from ridetune.stage import run_stage

from . import build

if __name__ == "__main__":
    sys.exit(run_stage(build.EnvelopeConfig, "configs/envelope.yaml", build.build, build.__doc__))
