"""The four scenarios: academy scenarios of Google Research Football 2.10.2 that the paper's benchmark uses.

Positions are fractions of the pitch as in the engine: x from -1 (own goal line) to 1, y from -0.42 (left of a player
who attacks) to 0.42. Those of the opponents are given from their own side.
"""

from dataclasses import dataclass

#: steps per second of the engine; each has ten of its physics
STEPS_PER_SECOND = 10
#: steps after which the engine ends a match
LIMIT_STEPS = 400
#: the engine's numbers of the players' roles
ROLES = ("GK", "CB", "LB", "RB", "DM", "CM", "LM", "RM", "AM", "CF")


@dataclass(frozen=True, slots=True)
class Start:
    """Where a player starts, and in which role."""

    x: float
    y: float
    role: str


@dataclass(frozen=True, slots=True)
class Scenario:
    """How matches start. They end with a goal, when the ball is out of play, and when it changes teams."""

    #: the task's name
    name: str
    #: the name in Google Research Football
    engine_name: str
    #: players of the team that agents control; the engine controls the others of the team
    n_agents: int
    ball: tuple[float, float]
    team: tuple[Start, ...]
    opponents: tuple[Start, ...]


_KEEPER = Start(-1.0, 0.0, "GK")
_TEAM_OF_11 = (
    _KEEPER,
    Start(-0.672, -0.19576, "LB"),
    Start(-0.75, -0.06356, "CB"),
    Start(-0.75, 0.063559, "CB"),
    Start(-0.672, 0.19576, "RB"),
    Start(-0.434, -0.10568, "CM"),
    Start(-0.434, 0.10568, "CM"),
    Start(0.5, -0.3161, "CM"),
    Start(0.25, -0.1, "LM"),
    Start(0.25, 0.1, "RM"),
    Start(0.35, 0.316102, "CF"),
)


def _opponents_of_11(centre_back_x: float) -> tuple[Start, ...]:
    return (
        _KEEPER,
        Start(0.128, -0.19576, "LB"),
        Start(centre_back_x, -0.06356, "CB"),
        Start(-0.4, 0.063559, "CB"),
        Start(0.128, -0.19576, "RB"),
        Start(0.365, -0.10568, "CM"),
        Start(0.282, 0.0, "CM"),
        Start(0.365, 0.10568, "CM"),
        Start(0.54, -0.3161, "LM"),
        Start(0.51, 0.0, "RM"),
        Start(0.54, 0.316102, "CF"),
    )


SCENARIOS = (
    Scenario(
        name="Football-3-vs-1",
        engine_name="academy_3_vs_1_with_keeper",
        n_agents=3,
        ball=(0.62, 0.0),
        team=(_KEEPER, Start(0.6, 0.0, "CM"), Start(0.7, 0.2, "CM"), Start(0.7, -0.2, "CM")),
        opponents=(_KEEPER, Start(-0.75, 0.0, "CB")),
    ),
    Scenario(
        name="Football-counterattack-easy",
        engine_name="academy_counterattack_easy",
        n_agents=4,
        ball=(0.26, -0.11),
        team=_TEAM_OF_11,
        opponents=_opponents_of_11(0.4),
    ),
    Scenario(
        name="Football-counterattack-hard",
        engine_name="academy_counterattack_hard",
        n_agents=4,
        ball=(0.26, -0.11),
        team=_TEAM_OF_11,
        opponents=_opponents_of_11(-0.4),
    ),
    Scenario(
        name="Football-pass-and-shoot",
        engine_name="academy_pass_and_shoot_with_keeper",
        n_agents=2,
        ball=(0.7, -0.28),
        team=(_KEEPER, Start(0.7, 0.0, "CB"), Start(0.7, -0.3, "CB")),
        opponents=(_KEEPER, Start(-0.75, 0.3, "CB")),
    ),
)
