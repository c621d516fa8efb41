"""What plugs into a run: installed methods and traits, and what a program hands over."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, get_args

from cucumbervision.errors import PluginError
from cucumbervision.methods.table import TableMethod, plugin_of
from cucumbervision.plugins import Kind, Plugin, faults, plugins
from cucumbervision.run.fields import fields_with, trait_field

if TYPE_CHECKING:
    from cucumbervision.protocols import Detector, Method, Segmenter, Trait
    from cucumbervision.run.fields import Field
    from cucumbervision.run.options import MeasureOptions


@dataclass(frozen=True, eq=False)
class PlugIns:
    """What a program hands over in Python; copied into other processes by `pickle`.

    Parameters
    ----------
    detector : Detector, optional
        Finds the fruit in place of `MeasureOptions.instances`. What has no mask is segmented.
    segmenter : Segmenter, optional
        Draws all masks in place of `MeasureOptions.segmenter`.
    methods : tuple of Method
        Methods beside those of `MeasureOptions.methods`.
    traits : tuple of Trait
        Traits beside the package's and the installed ones.
    """

    detector: Detector | None = None
    segmenter: Segmenter | None = None
    methods: tuple[Method, ...] = ()
    traits: tuple[Trait, ...] = ()


class RunPlugins:
    """Methods and traits of a run, loaded once; those that cannot be loaded are left out.

    Parameters
    ----------
    options : MeasureOptions
        The run's choices.
    plug_ins : PlugIns
        What the program hands over.

    Attributes
    ----------
    faults : list of PluginError
        What was left out, and why.
    """

    def __init__(self, options: MeasureOptions, plug_ins: PlugIns) -> None:
        self._options, self._plug_ins = options, plug_ins
        kinds: tuple[Kind, ...] = get_args(Kind)
        self.faults = [fault for kind in kinds for fault in faults(kind)]
        self.methods: list[str | Method] = []
        self.traits: list[tuple[Plugin, Trait]] = []
        all_methods: list[str | Method] = [*options.methods, *plug_ins.methods]
        for method in all_methods:
            try:
                TableMethod.of(method)
                self.methods.append(method)
            except PluginError as fault:
                self.faults.append(fault)
        taken = {field.name for field in fields_with(self._method_names(), ())}
        for plugin, trait in self._all_traits():
            try:
                part = plugin.load() if trait is None else trait
                name = trait_field(plugin, part).name
                if name in taken and not plugin.is_own:
                    raise plugin.error("has a name that is taken, and is left out")
                taken.add(name)
                self.traits.append((plugin, part))
            except PluginError as fault:
                self.faults.append(fault)

    def _all_traits(self) -> list[tuple[Plugin, Trait | None]]:
        listed: list[tuple[Plugin, Trait | None]] = [
            (plugin, None) for plugin in plugins("traits").values()
        ]
        for trait in self._plug_ins.traits:
            plugin = Plugin.of("traits", getattr(trait, "function", trait))
            try:
                name = plugin.call(lambda trait=trait: str(trait.name))
                listed.append((Plugin.of("traits", getattr(trait, "function", trait), name), trait))
            except PluginError as fault:
                self.faults.append(fault)
        return listed

    def _method_names(self) -> list[str]:
        """Return the methods whose columns there are, those that could not be loaded too."""
        names = [method if isinstance(method, str) else str(method.name) for method in self.methods]
        return [*self._options.methods, *names]

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """The columns of the run's tables."""
        return fields_with(self._method_names(), self.traits)

    @cached_property
    def lines(self) -> tuple[Plugin, ...]:
        """The lines of the table for methods and traits of other packages."""
        listed = (
            *(plugin_of(method) for method in self.methods),
            *(plugin for plugin, _ in self.traits),
        )
        return tuple(plugin for plugin in listed if not plugin.is_own)

    @property
    def models(self) -> tuple[dict[str, Any], ...]:
        """What files say of these."""
        return tuple(plugin.as_json() for plugin in self.lines)
