# SPDX-License-Identifier: GPL-3.0-or-later
"""A skeleton to begin with: fitted to splats, or read from what other programs found."""
