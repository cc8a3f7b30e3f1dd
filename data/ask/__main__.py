"""Let a vision model propose the words of proposed pairs: scene, condition, style, explanation.

    proposals -> frame (<= 768 px, JPEG) + instruction -> chat completion -> Answer -> proposals

In: a folder of `python -m data.propose` and an OpenAI-compatible endpoint, to which frames and
words are sent. Out: a folder of the same parts, with the model's words (annotator model:NAME) and
matrices of the rules, and what was skipped and why (skipped.csv). Every answer is kept in the
cache: a stopped run goes on where it was, and what was answered once never costs again.

    python -m data.ask --config configs/ask.yaml proposals=runs/own/proposals out=runs/own/asked
"""

import sys

from ridetune.stage import run_stage

from .config import AskConfig
from .run import ask

if __name__ == "__main__":
    sys.exit(run_stage(AskConfig, "configs/ask.yaml", ask, __doc__))
