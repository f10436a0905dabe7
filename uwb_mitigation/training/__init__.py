"""Select, fit and quantise models. Only `networks`, `augmentation` and `fitting` import torch at the top."""
