"""What commands share: console output, checks of options, model bundles."""
