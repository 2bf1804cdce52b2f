# SPDX-License-Identifier: Apache-2.0
"""Hydra composes a configuration once a process: tests ask for the same ones hundreds of times.

What a file says, which files a command and its options of groups combine, and what these say together, is kept, and
which packages are installed. Values of a command line are set anew each time. Nothing is kept of folders or other
packages, whose files a test may change.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.defaults_list import DefaultsList, Overrides
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from omegaconf import OmegaConf

from sphericalvision.recipes.app import running

Plugins.instance()  # which defines the classes of sources anew
PACKAGES, REGISTERED = map(SourcesRegistry.instance().resolve, ("pkg", "structured"))
load_config = PACKAGES.load_config
create_defaults_list = config_loader_impl.create_defaults_list
compose_defaults = ConfigLoaderImpl._compose_config_from_defaults_list
pickles: dict[str, bytes] = {}


def _once(sources: Sequence[Any], key: object, make: Callable[[], Any]) -> Any:
    """A copy of what was made of the package's and Hydra's own files; made anew of any other."""
    places = [source.path for source in sources]  # "": what plugins of Hydra have registered
    if any(place and not place.startswith(("sphericalvision.conf", "hydra.conf")) for place in places):
        return make()
    key = repr((places, key))
    if key not in pickles:
        pickles[key] = pickle.dumps(make())
    return pickle.loads(pickles[key])


def _load_config(source: Any, config_path: str) -> Any:
    return _once([source], config_path, lambda: load_config(source, config_path))


def _defaults_list(repo: Any, config_name: Any, overrides_list: list[Any], **options: Any) -> DefaultsList:
    """The files to combine: they depend on the command and on those of the overrides that choose files."""
    overrides = Overrides(repo=repo, overrides_list=overrides_list)
    key = config_name, options, vars(overrides) | {"config_overrides": None}
    result: DefaultsList = _once(
        repo.get_sources(), key, lambda: create_defaults_list(repo, config_name, overrides_list, **options)
    )
    result.config_overrides = overrides.config_overrides
    return result


def _composed(loader: ConfigLoaderImpl, defaults: list[Any], repo: Any) -> Any:
    """What files say together: it depends on their names, places and order."""
    result = _once(
        repo.get_sources(),
        [vars(default) for default in defaults],
        lambda: compose_defaults(loader, defaults, repo),
    )
    OmegaConf.clear_cache(result)  # of the time that it was composed at, which names folders of runs
    return result


def install() -> None:
    """Have Hydra keep what it composes."""
    PACKAGES.load_config = _load_config
    config_loader_impl.create_defaults_list = _defaults_list
    ConfigLoaderImpl._compose_config_from_defaults_list = _composed
    REGISTERED.__deepcopy__ = lambda source, memo: source  # it holds all that plugins registered
    running.entry_points = cache(running.entry_points)
