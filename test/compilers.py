"""Marks of tests that compile C or C++; without a compiler they are skipped with a reason."""

import shutil

import pytest

NEEDS_CC = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: apt install gcc")
NEEDS_CXX = pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler: apt install g++")
