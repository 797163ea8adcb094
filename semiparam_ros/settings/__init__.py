"""Parameters: one table, the snapshot an estimator works from, parameter files, and building an estimator."""

from semiparam_ros.settings.files import dump_params, load_params
from semiparam_ros.settings.parameter_table import PARAMETERS
from semiparam_ros.settings.snapshot import Settings

__all__ = ['PARAMETERS', 'Settings', 'dump_params', 'load_params']
