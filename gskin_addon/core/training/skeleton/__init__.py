# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the networks that find joints in splats."""
