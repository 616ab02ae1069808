"""The whole experiment as frozen dataclasses, and their YAML form.

Every field is a YAML key and a command-line flag. The text under a field is its documentation.
"""

from switchmt_snn.config.documentation import field_documentation
from switchmt_snn.config.evaluation import EvaluationConfig, RecordingConfig
from switchmt_snn.config.experiment import ExperimentConfig, clips_rewards, resolve
from switchmt_snn.config.learning import Engine, LearningConfig
from switchmt_snn.config.methods import METHOD_TRAITS, METHODS, Method, MethodTraits
from switchmt_snn.config.network import NetworkConfig
from switchmt_snn.config.plugins import PluginName
from switchmt_snn.config.suites import SuiteDefaults
from switchmt_snn.config.switching import POLICIES, Policy, SwitchingConfig
from switchmt_snn.config.tasks import TasksConfig, resolved_frame_stack
from switchmt_snn.config.yaml_io import differences, from_dict, load_config, presets, to_dict, to_yaml

__all__ = [
    "METHODS",
    "METHOD_TRAITS",
    "POLICIES",
    "Engine",
    "EvaluationConfig",
    "ExperimentConfig",
    "LearningConfig",
    "Method",
    "MethodTraits",
    "NetworkConfig",
    "PluginName",
    "Policy",
    "RecordingConfig",
    "SuiteDefaults",
    "SwitchingConfig",
    "TasksConfig",
    "clips_rewards",
    "differences",
    "field_documentation",
    "from_dict",
    "load_config",
    "presets",
    "resolve",
    "resolved_frame_stack",
    "to_dict",
    "to_yaml",
]
