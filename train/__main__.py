"""`python -m train`: LoRA fine-tuning."""

import sys

from ridetune.stage import run_stage

from .sft import TrainConfig, finetune

if __name__ == "__main__":
    sys.exit(run_stage(TrainConfig, "configs/train.yaml", finetune, __doc__))
