"""The one place that knows which methods of compensation there are."""

from __future__ import annotations

from tactiled.compensate import Compensator, Off
from tactiled.force_model import ForceModel
from tactiled.layout import Layout
from tactiled.pipeline_settings import PipelineSettings


def make_compensator(settings: PipelineSettings, layout: Layout, model: ForceModel) -> Compensator:
    """Compensator that ``settings`` ask for."""
    return Off(layout)
