"""The whole experiment as frozen dataclasses, and their YAML form.

Every field is a YAML key and a command-line flag. The text under a field is its documentation.
"""

from switchmt_snn.config.experiment import (
    METHOD_TRAITS,
    METHODS,
    POLICIES,
    Engine,
    EvaluationConfig,
    ExperimentConfig,
    LearningConfig,
    Method,
    MethodTraits,
    NetworkConfig,
    Policy,
    RecordingConfig,
    SwitchingConfig,
    TasksConfig,
    resolve,
    resolved_frame_stack,
)
from switchmt_snn.config.suites import SuiteDefaults
from switchmt_snn.config.yaml_io import differences, field_documentation, from_dict, load_config, to_dict, to_yaml

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
    "Policy",
    "RecordingConfig",
    "SuiteDefaults",
    "SwitchingConfig",
    "TasksConfig",
    "differences",
    "field_documentation",
    "from_dict",
    "load_config",
    "resolve",
    "resolved_frame_stack",
    "to_dict",
    "to_yaml",
]
