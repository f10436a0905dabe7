"""Fitting and quantising the model. Of the whole package only `networks`, `augmentation` and `fitting` here import torch."""
