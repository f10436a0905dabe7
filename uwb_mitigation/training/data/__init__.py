"""Training data: recordings as arrays, splits by placement, augmentation."""
