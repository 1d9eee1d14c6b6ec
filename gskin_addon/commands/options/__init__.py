# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of each command, one file per command; `add` gives them to the parser. Imports nothing heavy."""
