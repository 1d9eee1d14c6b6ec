# SPDX-License-Identifier: GPL-3.0-or-later
"""The job contract, the process that runs a job, and the client that starts, follows and stops it."""

from __future__ import annotations
