"""LoRA fine-tuning and the tiny base: `python -m train`, `python -m train.tiny`."""
