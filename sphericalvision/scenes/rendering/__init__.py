# SPDX-License-Identifier: Apache-2.0
"""What scenes are made of, and their pictures and exact depth through any camera."""
