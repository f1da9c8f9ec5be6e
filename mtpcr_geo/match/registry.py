"""Which matchers there are, and how one is made from its settings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.system import opencv_in_one_thread, usable_cores
from mtpcr_geo.core.types import Matches
from mtpcr_geo.match.base import Advance, Matcher, View
from mtpcr_geo.match.correlation import CorrelationSettings
from mtpcr_geo.match.learned.model_cards import ModelDescription, descriptions, models_folder, path_of
from mtpcr_geo.match.prior import Prior

if TYPE_CHECKING:
    # of matchers by keypoints; the default one does without, and is not to wait for them
    from mtpcr_geo.match.base import ImageMatcher
    from mtpcr_geo.match.descriptors import Extractor, FeatureMatcher
    from mtpcr_geo.match.keypoints import KeypointMatcher
    from mtpcr_geo.match.learned.proposals import LearnedProposals

BUILT_IN = ("correlation", "rootsift", "orb")
RATIO = 0.9


@dataclass(frozen=True)
class KeypointSettings:
    """What governs keypoint matchers.

    Attributes:
        models: folder of model files; the environment's if None.
        turns: orientations tried where a matcher does not bear any angle; the model's own if None.
        tolerance_m: plan distance within which matches agree on an orientation; from the cells if None.
        max_keypoints: kept of an image; the matcher's own if None.
        tile: edge of the tiles of learned extractors, pixels; the model's own if None.
        ratio: nearest over second nearest descriptor distance; the matcher's own if None.
        cross_check: whether nearest neighbours must be mutual; the matcher's own if None.
        device, threads: where and how wide onnxruntime works.

    """

    models: Path | None = None
    turns: int | None = None
    tolerance_m: float | None = None
    max_keypoints: int | None = None
    tile: int | None = None
    ratio: float | None = None
    cross_check: bool | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    threads: int = 0


@dataclass(frozen=True)
class CorrelationMatcher:
    """The default matcher as a `Matcher`.

    Attributes:
        settings: what governs the search.
        prior: what is known of the pose beforehand.
        provisional: whether a search that does not settle is left off, see `Matches.search_further`.

    """

    settings: CorrelationSettings
    prior: Prior | None = None
    provisional: bool = False
    needs_image: bool = False
    needs_one_cell: bool = True

    def match(
        self,
        source: View,
        target: View,
        *,
        seed: int = 0,
        yaw: float | None = None,
        advance: Advance = lambda n: None,
    ) -> Matches:
        """Search all yaws and all shifts, see `Matcher.match`; a known yaw is not made use of."""
        from mtpcr_geo.match.correlation import match

        return match(
            source.bev, target.bev, self.settings, seed, advance, self.prior, provisional=self.provisional
        )


def names(folder: Path | None) -> list[str]:
    """Name all matchers, those of described models included, whether their files are there or not."""
    return [*BUILT_IN, *descriptions(models_folder(folder))]


def make_matcher(name: str, correlation: CorrelationSettings, keypoints: KeypointSettings) -> Matcher:
    """Make a matcher.

    Args:
        name: what it is called.
        correlation, keypoints: settings of either kind.

    Raises:
        OptionError: if there is none of that name, or a description is wrong.
        MissingPartError: if a model's file is not there.
        InputError: if a model's file is not what its description says.

    """
    if name == "correlation":
        return CorrelationMatcher(correlation)
    return _by_keypoints(name, keypoints)


def _by_keypoints(name: str, keypoints: KeypointSettings) -> KeypointMatcher:
    from mtpcr_geo.match.keypoints import KeypointMatcher

    if name in ("rootsift", "orb"):
        return KeypointMatcher(name, _classical(name, keypoints), tolerance_m=keypoints.tolerance_m)
    folder = models_folder(keypoints.models)
    known = descriptions(folder)
    if name not in known:
        from mtpcr_geo.core.suggestions import meant

        raise OptionError(f"there is no matcher {name!r}{meant(name, [*BUILT_IN, *known])}")
    model = known[name]
    return KeypointMatcher(
        name,
        _learned(model, folder, keypoints),
        turns=model.turns if keypoints.turns is None else keypoints.turns,
        tolerance_m=keypoints.tolerance_m,
        magnify_to=model.extractor.magnify_to if model.extractor else 0,
        sweep_keypoints=model.matcher.sweep_keypoints if model.matcher else None,
        sweep_to=model.extractor.sweep_to if model.extractor else 0,
        candidates=model.extractor.candidates if model.extractor else 0,
    )


@dataclass(frozen=True)
class SmallerTurned:
    """A keypoint matcher that turns the raster of fewer filled cells, whichever is the source.

    Source and target exchanged give the inverse.

    Attributes:
        matcher: of the smaller raster to the larger one.

    """

    matcher: KeypointMatcher
    needs_image: bool = field(default=True, init=False)
    needs_one_cell: bool = field(default=True, init=False)

    def match(
        self,
        source: View,
        target: View,
        *,
        seed: int = 0,
        yaw: float | None = None,
        advance: Advance = lambda n: None,
    ) -> Matches:
        """Match two views, see `Matcher.match`."""
        from mtpcr_geo.match.correlation import exchanged

        with opencv_in_one_thread():
            if (source.bev.count > 0).sum() <= (target.bev.count > 0).sum():
                return self.matcher.match(source, target, seed=seed, yaw=yaw, advance=advance)
            yaw = None if yaw is None else -yaw
            found = self.matcher.match(target, source, seed=seed, yaw=yaw, advance=advance)
        return replace(
            exchanged(found),
            source_keypoints=found.target_keypoints,
            target_keypoints=found.source_keypoints,
        )


@dataclass
class Network:
    """The network in the package: it proposes poses and matches, and describes each image once for both.

    Its files are opened once they are needed.

    Attributes:
        threads: orientations described at once; as many as there are cores if 0.
        name: of a model in the package that describes all places of an image (`map_stride`).

    """

    threads: int = 0
    name: str = "bev"
    _images: FeatureMatcher | None = field(default=None, init=False, repr=False)

    def images(self) -> FeatureMatcher:
        """Return what describes images and pairs their keypoints."""
        if self._images is None:
            from mtpcr_geo.match.descriptors import Remembering

            # one thread for each orientation, so that no sum depends on how many there are
            settings = KeypointSettings(device="cpu", threads=1)
            made = cast("FeatureMatcher", _learned(descriptions(None)[self.name], None, settings))
            self._images = replace(made, extractor=Remembering(made.extractor))
        return self._images

    def forget(self) -> None:
        """Let go of the descriptions of images, some 100 MB where these are large."""
        from mtpcr_geo.match.descriptors import Remembering

        if self._images is not None:
            cast(Remembering, self._images.extractor).forget()

    def proposals(self) -> LearnedProposals:
        """Return what proposes poses to the correlation search."""
        from mtpcr_geo.match.learned.proposals import LearnedProposals

        return LearnedProposals(lambda: self.images().extractor, self.threads or usable_cores())

    def matcher(self, *, remembering: bool = True) -> SmallerTurned:
        """Return the matcher of whole rasters.

        Args:
            remembering: whether what was described before is not described again, which holds memory.

        """
        from mtpcr_geo.match.descriptors import Remembering
        from mtpcr_geo.match.keypoints import KeypointMatcher

        model = descriptions(None)[self.name]
        assert model.extractor is not None
        images = self.images()
        if not remembering:
            images = replace(images, extractor=cast(Remembering, images.extractor).extractor)
        return SmallerTurned(
            KeypointMatcher(
                self.name,
                images,
                turns=model.turns,
                magnify_to=model.extractor.magnify_to,
                candidates=model.extractor.candidates,
                workers=self.threads or usable_cores(),
            )
        )


def _classical(name: str, settings: KeypointSettings) -> ImageMatcher:
    from mtpcr_geo.match.descriptors import FeatureMatcher, NearestNeighbours, Orb, RootSift

    most = settings.max_keypoints or 8192
    extractor: Extractor = RootSift(most) if name == "rootsift" else Orb(most)
    ratio = RATIO if settings.ratio is None else settings.ratio
    return FeatureMatcher(extractor, NearestNeighbours(ratio, bool(settings.cross_check)), any_yaw=True)


def _learned(model: ModelDescription, folder: Path | None, settings: KeypointSettings) -> ImageMatcher:
    from mtpcr_geo.match.descriptors import FeatureMatcher, NearestNeighbours
    from mtpcr_geo.match.learned.lightglue import FusedLightGlue, LightGlue
    from mtpcr_geo.match.learned.onnx import OnnxExtractor, Running

    running = Running(settings.device, settings.threads)
    paths = {file: path_of(file, model, folder) for file in model.files}
    if model.fused is not None:
        path = paths[model.fused.file]
        return FusedLightGlue(model.fused, path, running, any_yaw=model.any_yaw)
    assert model.extractor is not None  # the description was checked
    extractor = OnnxExtractor(
        model.extractor,
        paths[model.extractor.file],
        running,
        tile=settings.tile,
        max_keypoints=settings.max_keypoints,
    )
    if model.matcher is not None:
        return FeatureMatcher(
            extractor, LightGlue(model.matcher, paths[model.matcher.file], running), model.any_yaw
        )
    own = model.nearest_neighbours
    assert own is not None
    nearest = NearestNeighbours(
        own.ratio if settings.ratio is None else settings.ratio,
        own.cross_check if settings.cross_check is None else settings.cross_check,
        own.least,
    )
    return FeatureMatcher(extractor, nearest, model.any_yaw)
