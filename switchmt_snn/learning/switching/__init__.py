"""Switching policies: at each episode end, stay on the task or go to the next one (paper, section 3.2.2, Algorithm 1).

A policy is a criterion (has learning on this task levelled off?) within bounds that all policies share (``bounds.py``).
One file per criterion:

=============================  ==================================================  =================================
name                           leaves when                                         file
=============================  ==================================================  =================================
fixed_episodes                 a number of episodes ended                          fixed_episodes.py
fixed_steps                    a number of steps passed                            fixed_steps.py
interleave                     any episode ended                                   interleave.py
parameter_change               Eq. 3 is below a threshold                          parameter_change.py
parameter_change_per_update    Eq. 3 per gradient step fell to a fraction          parameter_change_per_update.py
reward_plateau                 the returns no longer rise                          reward_plateau.py
parameter_and_reward           parameter_change and reward_plateau both leave      parameter_and_reward.py
value_change                   change of Q per gradient step fell to a fraction    value_change.py
deficit                        a task farther from its reference is owed steps     deficit.py
learning_progress              a task whose returns change faster is owed steps    learning_progress.py
plateau_and_return             the returns no longer rise; back when they fell     plateau_and_return.py
harmonic_gain                  a step elsewhere is expected to add more            harmonic_gain.py
dormancy_guard                 a number of steps passed, or neurons fell silent    dormancy_guard.py
=============================  ==================================================  =================================

A class from outside the package is named ``package.module:Class`` (docs/extending.md, Switching policy).
"""

from switchmt_snn.learning.switching import (
    deficit,
    dormancy_guard,
    fixed_episodes,
    fixed_steps,
    harmonic_gain,
    interleave,
    learning_progress,
    parameter_and_reward,
    parameter_change,
    parameter_change_per_update,
    plateau_and_return,
    reward_plateau,
    value_change,
)
from switchmt_snn.learning.switching.bounds import Stay, SwitchingPolicy, SwitchTo
from switchmt_snn.learning.switching.check import check_policy
from switchmt_snn.learning.switching.criterion import (
    CRITERIA,
    DECISION_COLUMNS,
    Criterion,
    Deciding,
    EpisodeRecord,
    Verdict,
    criterion_class,
    make_criterion,
    register_criterion,
    with_policy,
)

__all__ = [
    "CRITERIA",
    "DECISION_COLUMNS",
    "Criterion",
    "Deciding",
    "EpisodeRecord",
    "Stay",
    "SwitchTo",
    "SwitchingPolicy",
    "Verdict",
    "check_policy",
    "criterion_class",
    "deficit",
    "dormancy_guard",
    "fixed_episodes",
    "fixed_steps",
    "harmonic_gain",
    "interleave",
    "learning_progress",
    "make_criterion",
    "parameter_and_reward",
    "parameter_change",
    "parameter_change_per_update",
    "plateau_and_return",
    "register_criterion",
    "reward_plateau",
    "value_change",
    "with_policy",
]
