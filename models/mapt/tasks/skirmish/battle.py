"""The game of the skirmish tasks: E battles at once, advanced by game loops of 1/22.4 s in numpy.

In each loop, every living unit either attacks (heals) its target if this is in range, or moves towards it, or moves to
its goal. Attacks hit at once and all at the same time. Dimension letters: E battles, N agents, M enemies, U = N + M
units, agents first.
"""

import numpy as np
from numpy.typing import NDArray

from mapt.tasks.skirmish.maps import (
    AGENTS_START,
    ENEMIES_START,
    ENERGY_PER_SECOND,
    HEALTH_PER_ENERGY,
    LEAST_DAMAGE,
    LOOPS_PER_SECOND,
    MAP_SIZE,
    MAX_ENERGY,
    SHIELD_DELAY_SECONDS,
    SHIELD_PER_SECOND,
    SIGHT_RANGE,
    START_ENERGY,
    START_SPREAD,
    SkirmishMap,
    UnitType,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
#: No target.
NOBODY = -1
#: Coordinates of dead units where distances are computed: far from the map and from each other, so that no comparison
#: of distances needs a mask.
_FAR = 1e4
#: A distance that no two units have.
_NEVER = 1e9


class Battle:
    """E battles on one map. The arrays may be read and, between loops, written. `start` comes before the first loop."""

    def __init__(self, battle_map: SkirmishMap, n_envs: int) -> None:
        units = battle_map.units
        self.n_agents, self.n_units = len(battle_map.agents), len(units)
        shape = (n_envs, self.n_units)
        #: positions (E, U); a dead unit's are those of its death
        self.x, self.y = np.zeros(shape), np.zeros(shape)
        #: (E, U); a unit without health is dead
        self.health, self.shield, self.energy = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        #: (E, U): loops until the next attack, and since the last hit
        self.cooldown, self.unhurt = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
        #: (E, U): the unit that each one attacks or heals, or `NOBODY`. The enemies choose their own.
        self.target = np.full(shape, NOBODY, np.int64)
        #: (E, U): the last unit that each one hit or healed since this was last set to `NOBODY`
        self.hit = np.full(shape, NOBODY, np.int64)

        self.max_health = np.array([unit.health for unit in units])
        self.max_shield = np.array([unit.shield for unit in units])
        self.heals = np.array([unit.heals for unit in units])
        self.armed = np.array([unit.damage > 0 for unit in units])
        #: (U, U): whether a unit's attacks can hit another one
        self.can_hit = np.array([[can_hit(unit, other) for other in units] for unit in units])
        self.cooldown_loops = np.array([round(unit.cooldown_seconds * LOOPS_PER_SECOND) for unit in units])

        radius = np.array([unit.radius for unit in units])
        self._hits = np.array([float(unit.hits_per_attack) for unit in units])
        #: (U, U): damage of an attack to shields, and to health
        self._damage_to_shield = np.array([[attack_damage(unit, other, 0.0) for other in units] for unit in units])
        self._damage_to_health = np.array(
            [[attack_damage(unit, other, other.armour) for other in units] for unit in units]
        )
        #: (U, U): distance between centres within which a unit attacks or heals another
        self._reach = np.array([unit.range for unit in units])[:, None] + radius[:, None] + radius
        #: (U, U): distance between centres of two units that touch; never for one on the ground and one in the air
        flies = np.array([unit.flies for unit in units])
        self._touching = np.where(flies[:, None] == flies, radius[:, None] + radius, -_NEVER)
        np.fill_diagonal(self._touching, -_NEVER)
        self._pace = np.array([unit.speed for unit in units]) / LOOPS_PER_SECOND
        self._healing = np.array([unit.heals_per_second for unit in units]) / LOOPS_PER_SECOND
        self._recovery = np.array([unit.recovers_per_second for unit in units]) / LOOPS_PER_SECOND
        self._has_shields, self._has_healers = bool(self.max_shield.any()), bool(self.heals.any())
        self._has_recovery = bool(self._recovery.any())
        self._enemy_healers = np.flatnonzero(self.heals & (np.arange(self.n_units) >= self.n_agents))
        #: (M, N): distance to add to an agent that an enemy cannot hit
        enemies, agents = slice(self.n_agents, None), slice(self.n_agents)
        self._not_hit = np.where(self.can_hit[enemies, agents], 0.0, _NEVER)

        self._grave = _FAR * (1 + np.arange(self.n_units))
        self._first = np.arange(n_envs)[:, None] * self.n_units
        self._rows = np.arange(self.n_units) * self.n_units
        self._dx, self._dy, self._distance, self._push = np.empty((4, n_envs, self.n_units, self.n_units))

    def start(self, envs: NDArray[np.intp], rng: np.random.Generator) -> None:
        """Start new battles in these environments, at random positions near the two starts."""
        x, y = rng.uniform(-START_SPREAD, START_SPREAD, (2, len(envs), self.n_units))
        is_agent = np.arange(self.n_units) < self.n_agents
        self.x[envs] = np.where(is_agent, AGENTS_START[0], ENEMIES_START[0]) + x
        self.y[envs] = np.where(is_agent, AGENTS_START[1], ENEMIES_START[1]) + y
        self.health[envs], self.shield[envs] = self.max_health, self.max_shield
        self.energy[envs] = START_ENERGY * self.heals
        self.cooldown[envs] = self.unhurt[envs] = 0
        self.target[envs] = self.hit[envs] = NOBODY

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that determines the future of the battles, by name. Not copies."""
        names = ("x", "y", "health", "shield", "energy", "cooldown", "unhurt", "target", "hit")
        return {name: getattr(self, name) for name in names}

    def loop(self, goal_x: FloatArray, goal_y: FloatArray) -> None:
        """Advance every battle by one game loop.

        The agents' targets are in `target`. An agent whose target is dead stands still.

        Args:
            goal_x, goal_y: (E, N), where agents without a target go.
        """
        alive = self.health > 0
        self._measure_distances(alive)
        self._choose_enemy_targets()
        pair = self.target + self._rows  # of a row of U x U
        ordered = self.target != NOBODY
        pair[~ordered] = 0
        at = self._first + np.where(ordered, self.target, 0)
        engaged = ordered & alive & alive.take(at)
        in_range = engaged & (self._distance.take(pair + self._first * self.n_units) <= self._reach.take(pair))

        # Before anybody is hurt: a unit whose target dies in this loop has stood still to attack.
        move_x, move_y = self._moves(*self._goals(goal_x, goal_y, ordered, at), ~ordered | (engaged & ~in_range))
        self.cooldown -= self.cooldown > 0
        self._attack(in_range & self.armed & (self.cooldown == 0), pair, at)
        if self._has_healers:
            self._heal(in_range & self.heals, at)
        self._recover()
        self._move(move_x, move_y, alive)

    def _measure_distances(self, alive: NDArray[np.bool_]) -> None:
        """Write `_dx[e, i, j]`, the x of j less that of i, `_dy`, and their distance."""
        x, y = np.where(alive, self.x, self._grave), np.where(alive, self.y, self._grave)
        dx, dy, distance = self._dx, self._dy, self._distance
        np.subtract(x[:, None], x[:, :, None], out=dx)
        np.subtract(y[:, None], y[:, :, None], out=dy)
        np.multiply(dx, dx, out=distance)
        np.multiply(dy, dy, out=self._push)
        distance += self._push
        np.sqrt(distance, out=distance)

    def _choose_enemy_targets(self) -> None:
        """An enemy keeps its target while this is in reach, and otherwise attacks the nearest agent that it sees."""
        n = self.n_agents
        distance = self._distance[:, n:, :n] + self._not_hit
        own = np.where(self.target[:, n:] < n, self.target[:, n:], NOBODY)  # those who heal have a friend as target
        nearest = distance.argmin(axis=2)
        sees = np.take_along_axis(distance, nearest[..., None], 2)[..., 0] < SIGHT_RANGE
        kept = np.maximum(own, 0)[..., None]
        keeps = (own >= 0) & (
            np.take_along_axis(distance, kept, 2)[..., 0]
            <= np.take_along_axis(np.broadcast_to(self._reach[n:, :n], distance.shape), kept, 2)[..., 0]
        )
        self.target[:, n:] = np.where(keeps, own, np.where(sees, nearest, NOBODY))
        for healer in self._enemy_healers:
            # The nearest friend that is hurt and in sight, or else the nearest one, which it follows.
            hurt = self.health[:, n:] < self.max_health[n:]
            distance = self._distance[:, healer, n:]
            urgent = hurt & (distance < SIGHT_RANGE)
            ranked = np.where(self.heals[n:], _NEVER, np.where(urgent, distance, distance + MAP_SIZE * 2))
            self.target[:, healer] = n + ranked.argmin(axis=1)

    def _goals(
        self, goal_x: FloatArray, goal_y: FloatArray, ordered: NDArray[np.bool_], at: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Where each unit would go, (E, U): to its target if it has one."""
        n = self.n_agents
        x, y = np.full(ordered.shape, AGENTS_START[0]), np.full(ordered.shape, AGENTS_START[1])
        x[:, :n], y[:, :n] = goal_x, goal_y
        return np.where(ordered, self.x.take(at), x), np.where(ordered, self.y.take(at), y)

    def _moves(self, x: FloatArray, y: FloatArray, goes: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """How far each unit moves along x and y towards a point, (E, U)."""
        way_x, way_y = x - self.x, y - self.y
        length = np.sqrt(way_x * way_x + way_y * way_y)
        share = goes * np.minimum(self._pace / np.maximum(length, 1e-9), 1.0)
        return way_x * share, way_y * share

    def _attack(self, fires: NDArray[np.bool_], pair: IntArray, at: IntArray) -> None:
        """Let these units hit their targets."""
        self.cooldown = np.where(fires, self.cooldown_loops, self.cooldown)
        self.hit = np.where(fires, self.target, self.hit)
        where, which = at[fires], pair[fires]
        to_health = self._sum(where, self._damage_to_health.take(which))
        if not self._has_shields:
            self.health = np.maximum(self.health - to_health, 0.0)
            return
        to_shield = self._sum(where, self._damage_to_shield.take(which))
        hits = self._sum(where, np.broadcast_to(self._hits, fires.shape)[fires])
        passing = np.maximum(to_shield - self.shield, 0.0)
        # Hits on one unit in one loop are taken to be equal: the shield stops the first, and armour reduces the others.
        reduction = (to_shield - to_health) * np.ceil(passing * hits / np.maximum(to_shield, 1.0) - 1e-9)
        lost = np.where(passing > 0, np.maximum(passing - reduction / np.maximum(hits, 1.0), LEAST_DAMAGE), 0.0)
        self.health = np.maximum(self.health - lost, 0.0)
        self.shield = np.maximum(self.shield - to_shield, 0.0)
        self.unhurt = np.where(hits > 0, 0, self.unhurt + 1)

    def _heal(self, heals: NDArray[np.bool_], at: IntArray) -> None:
        cost = self._healing / HEALTH_PER_ENERGY
        wounded = (self.health.take(at) > 0) & (self.health < self.max_health).take(at)
        heals = heals & (self.health > 0) & (self.energy >= cost) & wounded
        healed = self._sum(at[heals], np.broadcast_to(self._healing, heals.shape)[heals])
        self.health = np.minimum(self.health + healed, self.max_health)
        self.energy = np.where(heals, self.energy - cost, self.energy)
        self.hit = np.where(heals, self.target, self.hit)

    def _recover(self) -> None:
        """Regenerate health, shields and energy."""
        alive = self.health > 0
        if self._has_recovery:
            self.health = np.where(alive, np.minimum(self.health + self._recovery, self.max_health), 0.0)
        if self._has_shields:
            rested = alive & (self.unhurt >= SHIELD_DELAY_SECONDS * LOOPS_PER_SECOND)
            gained = rested * (SHIELD_PER_SECOND / LOOPS_PER_SECOND)
            self.shield = np.where(alive, np.minimum(self.shield + gained, self.max_shield), 0.0)
        if self._has_healers:
            gained = (alive & self.heals) * (ENERGY_PER_SECOND / LOOPS_PER_SECOND)
            self.energy = np.minimum(self.energy + gained, MAX_ENERGY)

    def _move(self, move_x: FloatArray, move_y: FloatArray, alive: NDArray[np.bool_]) -> None:
        """Move living units, and push those apart that overlapped at the beginning of the loop."""
        push = np.subtract(self._touching, self._distance, out=self._push)
        np.maximum(push, 0.0, out=push)
        np.maximum(self._distance, 1e-6, out=self._distance)
        push /= self._distance
        move_x -= 0.5 * np.vecdot(push, self._dx)
        move_y -= 0.5 * np.vecdot(push, self._dy)
        self.x = np.clip(self.x + alive * move_x, 0.0, MAP_SIZE)
        self.y = np.clip(self.y + alive * move_y, 0.0, MAP_SIZE)

    def _sum(self, units: IntArray, amounts: FloatArray) -> FloatArray:
        """The sum of the amounts of each unit, (E, U), from flat indices of units."""
        totals = np.bincount(units, weights=amounts, minlength=self.health.size)
        return totals.reshape(self.health.shape).astype(np.float64, copy=False)


def can_hit(attacker: UnitType, target: UnitType) -> bool:
    """Whether the attacker's weapon can hit such a target at all."""
    return attacker.damage > 0 and (attacker.hits_flyers or not target.flies)


def attack_damage(attacker: UnitType, target: UnitType, armour: float) -> float:
    """Damage of one attack, of one or several hits, against this armour."""
    if not can_hit(attacker, target):
        return 0.0
    hit = attacker.damage + attacker.bonus_against_armoured * target.armoured
    return attacker.hits_per_attack * max(hit - armour, LEAST_DAMAGE)
