# SPDX-License-Identifier: GPL-3.0-or-later
"""What `make demo` makes: a character modelled by code, turned into splats, and skinned by gskin."""
