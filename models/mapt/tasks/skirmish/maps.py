"""The units and maps of the skirmish tasks.

Numbers of units are those of StarCraft II 4.10 at the speed "faster", in which a game loop lasts 1/22.4 s, without
upgrades. Numbers of maps are those of SMAC (Samvelyan et al. 2019): armies, limits, ranges and where teams start.
"""

from dataclasses import dataclass

#: game loops per second, and per environment step
LOOPS_PER_SECOND, LOOPS_PER_STEP = 22.4, 8
#: side of the square map, and where the agents and their enemies start
MAP_SIZE = 32.0
AGENTS_START, ENEMIES_START = (9.0, 16.0), (23.0, 16.0)
#: units start within this distance of their team's start, along each axis
START_SPREAD = 2.0
#: distances between centres at which agents see units, and may choose to attack or heal them
SIGHT_RANGE, SHOOT_RANGE = 9.0, 6.0
#: distance from its position of the point to which an agent moves
MOVE_DISTANCE = 2.0
#: damage of a hit that armour reduces below this
LEAST_DAMAGE = 0.5
#: shields recover this much in a second, once their unit has not been hit for this long
SHIELD_PER_SECOND, SHIELD_DELAY_SECONDS = 2.8, 7.0
#: of a healer
START_ENERGY, MAX_ENERGY, ENERGY_PER_SECOND = 50.0, 200.0, 0.7875
HEALTH_PER_ENERGY = 3.0
#: rewards, before they are scaled so that an episode has at most the return `BEST_RETURN`
KILL_REWARD, WIN_REWARD, BEST_RETURN = 10.0, 200.0, 20.0


@dataclass(frozen=True, slots=True)
class UnitType:
    """One kind of unit. Distances are in map units, of which a map has 32 on a side."""

    name: str
    health: float
    #: Subtracted from each hit on health, not on shields.
    armour: float
    #: Damage of one hit; a unit with 0 cannot attack.
    damage: float
    #: Time between two attacks.
    cooldown_seconds: float
    #: From surface to surface, of the attack or of healing.
    range: float
    #: Per second.
    speed: float
    radius: float
    shield: float = 0.0
    #: Added to a hit on an armoured unit.
    bonus_against_armoured: float = 0.0
    hits_per_attack: int = 1
    armoured: bool = False
    flies: bool = False
    hits_flyers: bool = True
    #: Health that it restores to a friend in a second.
    heals_per_second: float = 0.0
    #: Health that it recovers in a second.
    recovers_per_second: float = 0.0

    @property
    def heals(self) -> bool:
        return self.heals_per_second > 0


MARINE = UnitType("Marine", health=45, armour=0, damage=6, cooldown_seconds=0.61, range=5, speed=3.15, radius=0.375)
MARAUDER = UnitType(
    "Marauder",
    health=125,
    armour=1,
    damage=10,
    bonus_against_armoured=10,
    cooldown_seconds=1.07,
    range=6,
    speed=3.15,
    radius=0.5625,
    armoured=True,
    hits_flyers=False,
)
MEDIVAC = UnitType(
    "Medivac",
    health=150,
    armour=1,
    damage=0,
    cooldown_seconds=0,
    range=4,
    speed=3.5,
    radius=0.75,
    armoured=True,
    flies=True,
    heals_per_second=12.6,
)
STALKER = UnitType(
    "Stalker",
    health=80,
    shield=80,
    armour=1,
    damage=13,
    bonus_against_armoured=5,
    cooldown_seconds=1.34,
    range=6,
    speed=4.13,
    radius=0.625,
    armoured=True,
)
ZEALOT = UnitType(
    "Zealot",
    health=100,
    shield=50,
    armour=1,
    damage=8,
    hits_per_attack=2,
    cooldown_seconds=0.86,
    range=0.1,
    speed=3.15,
    radius=0.5,
    hits_flyers=False,
)
HYDRALISK = UnitType(
    "Hydralisk",
    health=90,
    armour=0,
    damage=12,
    cooldown_seconds=0.59,
    range=5,
    speed=3.15,
    radius=0.625,
    recovers_per_second=0.38,
)


@dataclass(frozen=True, slots=True)
class SkirmishMap:
    """Two armies and the time they have."""

    name: str
    agents: tuple[UnitType, ...]
    enemies: tuple[UnitType, ...]
    limit_steps: int

    @property
    def units(self) -> tuple[UnitType, ...]:
        """All units: agents, then enemies."""
        return self.agents + self.enemies

    @property
    def types(self) -> tuple[UnitType, ...]:
        """The kinds of unit, in the order of their first appearance."""
        return tuple(dict.fromkeys(self.units))


MAPS = (
    SkirmishMap("3m", 3 * (MARINE,), 3 * (MARINE,), 60),
    SkirmishMap("3s5z", 3 * (STALKER,) + 5 * (ZEALOT,), 3 * (STALKER,) + 5 * (ZEALOT,), 150),
    SkirmishMap("6h_vs_8z", 6 * (HYDRALISK,), 8 * (ZEALOT,), 150),
    SkirmishMap(
        "MMM2",
        2 * (MARAUDER,) + 7 * (MARINE,) + (MEDIVAC,),
        3 * (MARAUDER,) + 8 * (MARINE,) + (MEDIVAC,),
        180,
    ),
)
