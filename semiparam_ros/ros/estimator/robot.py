"""The robot's description: from the parameters at once, or from the topic when it comes."""

from __future__ import annotations

from collections.abc import Callable

from semiparam_ros.core.robot import urdf as urdf_tree
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.build import build_rigid_body
from semiparam_ros.settings.robot_description import robot_description
from semiparam_ros.settings.snapshot import Settings


class Robot:
    """Builds the rigid body as soon as there is a description that fits.

    :param known: receives the body, once. :param complain: receives a sentence about one that does not fit.
    """

    def __init__(self, settings: Settings, known: Callable[[RigidBody], None],
                 complain: Callable[[str], None]) -> None:
        self._settings, self._known, self._complain = settings, known, complain
        self._text: str | None = None
        self._latest = self._refusal = ''
        self.name = ''

    @property
    def description(self) -> str:
        """The text in use; raises SemiparamError while there is none."""
        if self._text is None:
            raise SemiparamError('there is no model yet: the robot description has not come.')
        return self._text

    def from_parameters(self) -> None:
        """Use the description of the parameters, if they hold one; raises SemiparamError when it does not fit."""
        if self._settings.robot_description_file or self._settings.robot_description:
            self._take(robot_description(self._settings))

    def from_topic(self, text: str) -> None:
        """Use the first one that fits; a different one later is not followed, for the model belongs to the first."""
        given = self._settings.robot_description_file or self._settings.robot_description
        if given or text in (self._latest, self._text):
            return
        self._latest = text
        if self._text is not None:
            self._complain('another robot description came on its topic; the first one stays in use.')
            return
        self._refusal = ''
        self.retry()

    def retry(self) -> None:
        """Take the latest from the topic, which may fit other settings; say why it does not fit, once."""
        if self._text is not None or not self._latest:
            return
        try:
            self._take(self._latest)
        except SemiparamError as error:
            refusal, before = f'the robot description on its topic does not fit: {error}', self._refusal
            self._refusal = refusal
            if refusal != before:
                self._complain(refusal)

    def _take(self, text: str) -> None:
        body = build_rigid_body(self._settings, text)
        self.name = urdf_tree.parse(text).get('name') or ''
        self._known(body)
        self._text = text
