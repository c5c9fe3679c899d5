"""A performer of high resolution with pores, and wrinkles that fold with a lag; expressions cut from real takes."""

from torchface.synthetic.stages.wrinkles.expression_sequences import expression_sequences, from_neutral_to_neutral
from torchface.synthetic.stages.wrinkles.wrinkled_performer import FOLD_TIME, UNFOLD_TIME, WrinkledPerformer

__all__ = ["FOLD_TIME", "UNFOLD_TIME", "WrinkledPerformer", "expression_sequences", "from_neutral_to_neutral"]
