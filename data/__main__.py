"""`python -m data`: build the dataset."""

import sys

from ridetune.stage import run_stage

from .build import DataConfig, build

if __name__ == "__main__":
    sys.exit(run_stage(DataConfig, "configs/data.yaml", build, __doc__))
