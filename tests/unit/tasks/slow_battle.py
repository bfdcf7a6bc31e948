"""One battle of the skirmish tasks, unit by unit in plain Python: what `Battle` computes for all at once."""

import math
from dataclasses import dataclass

from mapt.tasks.skirmish import maps
from mapt.tasks.skirmish.battle import Battle
from mapt.tasks.skirmish.maps import LOOPS_PER_SECOND, SkirmishMap, UnitType


@dataclass
class Unit:
    kind: UnitType
    number: int
    is_agent: bool
    x: float
    y: float
    health: float
    shield: float
    energy: float
    cooldown: int
    unhurt: int
    target: int

    @property
    def alive(self) -> bool:
        return self.health > 0


class SlowBattle:
    """A copy of one environment of a battle."""

    def __init__(self, battle_map: SkirmishMap, battle: Battle, env: int) -> None:
        n = len(battle_map.agents)
        names = ("x", "y", "health", "shield", "energy", "cooldown", "unhurt", "target")
        self.units = [
            Unit(kind, number, number < n, *(getattr(battle, name)[env, number].item() for name in names))
            for number, kind in enumerate(battle_map.units)
        ]
        self.agents, self.enemies = self.units[:n], self.units[n:]

    def loop(self, goals: list[tuple[float, float]]) -> None:
        alive = [unit for unit in self.units if unit.alive]
        for enemy in self.enemies:
            enemy.target = self._enemy_target(enemy)
        moves = {unit.number: self._move(unit, goals) for unit in alive}
        attacks: dict[int, list[tuple[float, float, int]]] = {}
        for unit in self.units:
            unit.cooldown = max(unit.cooldown - 1, 0)
            if unit.alive and unit.kind.damage and unit.cooldown == 0 and self._in_range(unit):
                unit.cooldown = round(unit.kind.cooldown_seconds * LOOPS_PER_SECOND)
                attacks.setdefault(unit.target, []).append(self._damage(unit, self.units[unit.target]))
        reached = [unit for unit in alive if unit.kind.heals and self._in_range(unit)]
        for unit in self.units:
            unit.unhurt += 1
            if unit.number in attacks:
                unit.unhurt = 0
                self._hurt(unit, attacks[unit.number])
        for healer in reached:
            self._heal(healer)
        pushes = {unit.number: self._push(unit, alive) for unit in alive}
        for unit in self.units:
            self._recover(unit)
        for unit in alive:
            (move_x, move_y), (push_x, push_y) = moves[unit.number], pushes[unit.number]
            unit.x = min(max(unit.x + move_x + push_x, 0.0), maps.MAP_SIZE)
            unit.y = min(max(unit.y + move_y + push_y, 0.0), maps.MAP_SIZE)

    def _enemy_target(self, enemy: Unit) -> int:
        def near(other: Unit) -> float:
            return distance(enemy, other)

        if enemy.kind.heals:
            friends = [unit for unit in self.enemies if unit.alive and not unit.kind.heals]
            hurt = [unit for unit in friends if unit.health < unit.kind.health and near(unit) < maps.SIGHT_RANGE]
            chosen = min(hurt or friends, key=near, default=enemy)
            return chosen.number
        foes = [unit for unit in self.agents if unit.alive and (enemy.kind.hits_flyers or not unit.kind.flies)]
        if any(unit.number == enemy.target and self._in_range(enemy) for unit in foes):
            return enemy.target
        seen = [unit for unit in foes if near(unit) < maps.SIGHT_RANGE]
        return min(seen, key=near).number if seen else -1

    def _in_range(self, unit: Unit) -> bool:
        if unit.target < 0 or not self.units[unit.target].alive:
            return False
        target = self.units[unit.target]
        return distance(unit, target) <= unit.kind.range + unit.kind.radius + target.kind.radius

    def _move(self, unit: Unit, goals: list[tuple[float, float]]) -> tuple[float, float]:
        if unit.target >= 0:
            target = self.units[unit.target]
            if not target.alive or self._in_range(unit):
                return 0.0, 0.0
            goal = target.x, target.y
        else:
            goal = goals[unit.number] if unit.is_agent else maps.AGENTS_START
        way_x, way_y = goal[0] - unit.x, goal[1] - unit.y
        length = math.hypot(way_x, way_y)
        share = min(unit.kind.speed / LOOPS_PER_SECOND / max(length, 1e-9), 1.0)
        return way_x * share, way_y * share

    @staticmethod
    def _damage(unit: Unit, target: Unit) -> tuple[float, float, int]:
        """Damage to shields, to health, and hits."""
        hit = unit.kind.damage + (unit.kind.bonus_against_armoured if target.kind.armoured else 0)
        hits = unit.kind.hits_per_attack
        return hit * hits, max(hit - target.kind.armour, 0.5) * hits, hits

    @staticmethod
    def _hurt(unit: Unit, attacks: list[tuple[float, float, int]]) -> None:
        to_shield, to_health = sum(a[0] for a in attacks), sum(a[1] for a in attacks)
        hits = sum(a[2] for a in attacks)
        if unit.shield <= 0:
            unit.health = max(unit.health - to_health, 0.0)
            return
        through = to_shield - unit.shield
        unit.shield = max(-through, 0.0)
        if through > 0:
            hits_through = math.ceil(through / (to_shield / hits) - 1e-9)
            armour_per_hit = (to_shield - to_health) / hits
            unit.health = max(unit.health - max(through - armour_per_hit * hits_through, 0.5), 0.0)

    def _heal(self, healer: Unit) -> None:
        target = self.units[healer.target]
        amount = healer.kind.heals_per_second / LOOPS_PER_SECOND
        cost = amount / maps.HEALTH_PER_ENERGY
        if healer.alive and target.alive and target.health < target.kind.health and healer.energy >= cost:
            target.health = min(target.health + amount, target.kind.health)
            healer.energy -= cost

    @staticmethod
    def _push(unit: Unit, alive: list[Unit]) -> tuple[float, float]:
        x = y = 0.0
        for other in alive:
            apart = distance(unit, other)
            overlap = unit.kind.radius + other.kind.radius - apart
            if other is not unit and other.kind.flies == unit.kind.flies and overlap > 0:
                x += 0.5 * overlap * (unit.x - other.x) / max(apart, 1e-6)
                y += 0.5 * overlap * (unit.y - other.y) / max(apart, 1e-6)
        return x, y

    @staticmethod
    def _recover(unit: Unit) -> None:
        if not unit.alive:
            unit.shield = 0.0
            return
        kind = unit.kind
        unit.health = min(unit.health + kind.recovers_per_second / LOOPS_PER_SECOND, kind.health)
        if unit.unhurt >= maps.SHIELD_DELAY_SECONDS * LOOPS_PER_SECOND:
            unit.shield = min(unit.shield + maps.SHIELD_PER_SECOND / LOOPS_PER_SECOND, kind.shield)
        if kind.heals:
            unit.energy = min(unit.energy + maps.ENERGY_PER_SECOND / LOOPS_PER_SECOND, maps.MAX_ENERGY)


def distance(unit: Unit, other: Unit) -> float:
    return math.hypot(unit.x - other.x, unit.y - other.y)
