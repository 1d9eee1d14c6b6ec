# SPDX-License-Identifier: GPL-3.0-or-later
"""The chapters of hands.py, each about one kind of tool."""
