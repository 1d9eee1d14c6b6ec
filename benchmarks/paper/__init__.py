# SPDX-License-Identifier: GPL-3.0-or-later
"""The paper's tables in the paper's protocol."""
