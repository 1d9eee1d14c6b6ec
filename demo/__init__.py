# SPDX-License-Identifier: GPL-3.0-or-later
"""The sample that `make demo` makes: a character modelled by code, turned into splats, and skinned by gskin."""
