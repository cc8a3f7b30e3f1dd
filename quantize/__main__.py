"""`python -m quantize`: merged model -> 4-bit AWQ checkpoint."""

import sys

from ridetune.stage import run_stage

from .build import QuantizeConfig, quantize

if __name__ == "__main__":
    sys.exit(run_stage(QuantizeConfig, "configs/quantize.yaml", quantize, __doc__))
