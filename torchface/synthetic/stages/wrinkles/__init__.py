"""A performer of high resolution with pores, and wrinkles that fold with a lag."""

from torchface.synthetic.stages.wrinkles.wrinkled_performer import FOLD_TIME, UNFOLD_TIME, WrinkledPerformer

__all__ = ["FOLD_TIME", "UNFOLD_TIME", "WrinkledPerformer"]
