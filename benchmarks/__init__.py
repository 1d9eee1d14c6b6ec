# SPDX-License-Identifier: GPL-3.0-or-later
"""Quality and speed runs that print tables; never imported by the add-on."""
