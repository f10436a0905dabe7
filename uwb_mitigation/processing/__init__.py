"""Correct recorded bags: selection of bags, processing of one bag, and parallel processing. Nothing here prints."""
