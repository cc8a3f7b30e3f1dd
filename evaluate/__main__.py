"""`python -m evaluate`: score the served bundle."""

import sys

from ridetune.stage import run_stage

from .report import EvaluateConfig, evaluate

if __name__ == "__main__":
    sys.exit(run_stage(EvaluateConfig, "configs/evaluate.yaml", evaluate, __doc__))
