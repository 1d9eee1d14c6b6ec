# SPDX-License-Identifier: GPL-3.0-or-later
"""The numeric core: arrays in, arrays out; never imports bpy."""
