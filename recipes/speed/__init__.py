# SPDX-License-Identifier: Apache-2.0
"""Speed, compared with a plain way to do the same."""

from sphericalvision.recipes.app.command import Command

main = Command("speed", "speed.command:measure_speed")
