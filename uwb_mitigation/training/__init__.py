"""Fitting and quantising the model. Of the whole package only `networks` and `fitting` here import torch."""
