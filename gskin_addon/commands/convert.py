# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin convert`: a file of splats in another format."""

from __future__ import annotations

import argparse

from ..core.errors import InputError
from ..core.splats.axes import rotate_cloud, up_rotation
from ..core.splats.formats import FILE_TYPES, output_format, write_splats
from .console import print_message
from .paths import check_output, same_file
from .rig import read_splats
from .save import say_left_out

UNSTATED = "-y"
"""The up axis of files whose format has no rule: that of COLMAP, and so of most training programs."""


def run(options: argparse.Namespace) -> None:
    """Do it. Raises InputError for what cannot be used."""
    check_output(options.out, "OUT", (*FILE_TYPES, ".json"))
    if same_file(options.source, options.out):
        raise InputError(f"OUT '{options.out}' would overwrite its own input; choose another name.")
    cloud = read_splats(options.source, options.drop_invalid)
    form = output_format(options.out)
    up, wanted = options.up or cloud.up or UNSTATED, options.out_up or form.up or UNSTATED
    if wanted != up and not (form.up or options.out_up or options.up):
        axes = f"'{options.out}' is {wanted.upper()} up, '{options.source}' {up.upper()}"
        print_message(f"{axes}; --out-up={up} keeps that.")
    turned = rotate_cloud(cloud, up_rotation(wanted).T @ up_rotation(up))
    write_splats(options.out, turned, up=form.up)
    say_left_out(options.out, turned)
    print_message(f"'{options.out}' has {cloud.count:,} splats, spherical harmonics of degree {cloud.sh_degree}.")
