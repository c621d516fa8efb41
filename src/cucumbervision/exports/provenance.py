"""What a round's stops were measured with, by hash."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cucumbervision.store.repository import Store

__all__ = ["StopArtifacts", "hashes_of", "stop_artifacts", "utc"]


@dataclass(frozen=True)
class StopArtifacts:
    """What stops were measured with.

    Parameters
    ----------
    by_stop : mapping of str to tuple of (kind, name, sha256)
        By the stops' keys.
    counted : tuple of mapping
        Each once: kind, name, sha256 and the number of stops.
    """

    by_stop: Mapping[str, tuple[tuple[str, str, str], ...]]
    counted: tuple[dict[str, Any], ...]


def stop_artifacts(store: Store, round_key: str) -> StopArtifacts:
    """Read models, calibrations and options of a round's stops, in one query."""
    from sqlalchemy import select

    from cucumbervision.store.engine import begin
    from cucumbervision.store.schema import Artifact, Round, StopArtifact, StopLine

    query = (
        select(StopLine.key, Artifact.kind, Artifact.name, Artifact.sha256)
        .join(StopArtifact, StopArtifact.stop_id == StopLine.id)
        .join(Artifact, Artifact.id == StopArtifact.artifact_id)
        .join(Round, Round.id == StopLine.round_id)
        .where(Round.key == round_key)
        .order_by(StopLine.id, StopArtifact.number)
    )
    by_stop: dict[str, list[tuple[str, str, str]]] = {}
    with begin(store.engine) as connection:
        for key, kind, name, sha256 in connection.execute(query):
            by_stop.setdefault(key, []).append((kind, name, sha256))
    counts = Counter(one for used in by_stop.values() for one in used)
    return StopArtifacts(
        {key: tuple(used) for key, used in by_stop.items()},
        tuple(
            {"kind": kind, "name": name, "sha256": sha256, "stops": number}
            for (kind, name, sha256), number in sorted(counts.items())
        ),
    )


def hashes_of(artifacts: StopArtifacts, stop_key: str) -> dict[str, str]:
    """Give the hashes of a stop's options, networks and calibration; several by blanks."""
    used = artifacts.by_stop.get(stop_key, ())
    return {
        column: " ".join(sha256 for kind, _, sha256 in used if kind == wanted and sha256)
        for column, wanted in (
            ("config_sha256", "config"),
            ("models_sha256", "model"),
            ("calibration_sha256", "calibration"),
        )
    }


def utc(seconds: float | None) -> str | None:
    """Give a time as people and programs read it; None stays None.

    Examples
    --------
    >>> utc(86400.5)
    '1970-01-02T00:00:00Z'
    """
    if seconds is None:
        return None
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
