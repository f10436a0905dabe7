"""Marks of tests that compile C or C++; such a test is skipped, in words, where nothing can."""

from __future__ import annotations

import shutil

import pytest

NEEDS_CC = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: apt install gcc")
NEEDS_CXX = pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler: apt install g++")
