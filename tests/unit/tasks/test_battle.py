"""The game of the skirmish tasks, one mechanic at a time and against a slow copy."""

import numpy as np
import pytest

from mapt.tasks.skirmish.battle import NOBODY, Battle
from mapt.tasks.skirmish.maps import (
    AGENTS_START,
    HYDRALISK,
    LOOPS_PER_SECOND,
    MAPS,
    MARAUDER,
    MARINE,
    MEDIVAC,
    STALKER,
    ZEALOT,
    SkirmishMap,
    UnitType,
)
from unit.tasks.slow_battle import SlowBattle


def duel(agents: tuple[UnitType, ...], enemies: tuple[UnitType, ...], gap: float = 1.5) -> Battle:
    """One battle in which the agents stand in a column and the enemies in another, `gap` to the right."""
    battle = Battle(SkirmishMap("duel", agents, enemies, 100), 1)
    battle.start(np.arange(1), np.random.default_rng(0))
    n, m = len(agents), len(enemies)
    battle.x[0] = [10.0] * n + [10.0 + gap] * m
    battle.y[0] = [10.0 + 2 * unit for unit in (*range(n), *range(m))]
    return battle


def loop(battle: Battle, times: int = 1) -> None:
    """Advance, with the agents standing where they are."""
    n = battle.n_agents
    goal_x, goal_y = battle.x[:, :n].copy(), battle.y[:, :n].copy()
    for _ in range(times):
        battle.loop(goal_x, goal_y)


def attack(battle: Battle, target: int, agent: int = 0) -> None:
    battle.target[0, agent] = target


@pytest.mark.parametrize(
    ("attacker", "target", "damage"),
    [
        (MARINE, MARINE, 6),
        (MARINE, MARAUDER, 5),  # one point of armour
        (MARAUDER, MARAUDER, 19),  # the bonus against armoured units
        (MARAUDER, MARINE, 10),
        (ZEALOT, HYDRALISK, 16),  # two hits
        (ZEALOT, MARAUDER, 14),  # armour counts for each of them
    ],
)
def test_armour_and_bonuses_change_the_damage_of_each_hit(attacker: UnitType, target: UnitType, damage: float) -> None:
    battle = duel((attacker,), (target,), gap=1.0)
    attack(battle, 1)
    loop(battle)
    assert battle.health[0, 1] == pytest.approx(target.health - damage + target.recovers_per_second / LOOPS_PER_SECOND)


@pytest.mark.parametrize(
    ("shield", "left", "health"),
    [
        (80, 67, 80),  # armour does not protect a shield
        (5, 0, 80 - (13 + 5 - 5 - 1)),  # what passes the shield is reduced by armour once
        (0, 0, 80 - (13 + 5 - 1)),
    ],
)
def test_a_shield_takes_damage_before_health(shield: float, left: float, health: float) -> None:
    battle = duel((STALKER,), (STALKER,), gap=3.0)
    battle.shield[0, 1] = shield
    battle.cooldown[0, 1] = 1000
    attack(battle, 1)
    loop(battle)
    assert (battle.shield[0, 1], battle.health[0, 1]) == (max(shield - 18, left if shield < 18 else 0), health)


def test_the_second_hit_passes_a_shield_that_the_first_has_used_up() -> None:
    battle = duel((ZEALOT,), (ZEALOT,), gap=1.0)
    battle.shield[0, 1] = 8
    attack(battle, 1)
    loop(battle)
    assert (battle.shield[0, 1], battle.health[0, 1]) == (0, 100 - 7)


def test_attacks_of_one_loop_add_up_and_a_unit_without_health_is_dead() -> None:
    battle = duel((MARINE,) * 3, (MARINE,), gap=2.0)
    battle.health[0, 3] = 13
    for agent in range(3):
        attack(battle, 3, agent)
    loop(battle)
    assert battle.health[0, 3] == 0
    x = battle.x[0, 3]
    loop(battle, 20)
    assert battle.x[0, 3] == x
    assert battle.health[0].tolist() == [45 - 6, 45, 45, 0]  # it had fired in the loop in which it died


def test_a_unit_attacks_again_after_its_cooldown() -> None:
    battle = duel((MARINE,), (STALKER,), gap=3.0)
    battle.cooldown[0, 1] = 10_000
    attack(battle, 1)
    shields = []
    for _ in range(30):
        loop(battle)
        shields.append(battle.shield[0, 1])
    lost = np.flatnonzero(np.diff([80, *shields]))
    assert lost.tolist() == [0, 14, 28]  # 0.61 s are 14 game loops


def test_shields_recover_after_seven_seconds_without_a_hit() -> None:
    battle = duel((STALKER,), (STALKER,), gap=3.0)
    battle.cooldown[0, 1] = 10_000
    attack(battle, 1)
    loop(battle)
    battle.target[0, 0] = NOBODY
    hurt = battle.shield[0, 1]
    loop(battle, int(7 * LOOPS_PER_SECOND))
    assert battle.shield[0, 1] == hurt == 62
    loop(battle, 8)
    assert battle.shield[0, 1] == pytest.approx(62 + 8 * 2.8 / LOOPS_PER_SECOND)
    loop(battle, 400)
    assert battle.shield[0, 1] == 80
    assert battle.health[0, 1] == 80  # health does not recover


def test_hydralisks_recover_health() -> None:
    battle = duel((HYDRALISK,), (MARINE,), gap=20.0)
    battle.health[0, 0] = 50
    loop(battle, 8)
    assert battle.health[0, 0] == pytest.approx(50 + 8 * 0.38 / LOOPS_PER_SECOND)


def test_a_medivac_heals_a_wounded_friend_at_the_cost_of_energy() -> None:
    battle = duel((MARINE, MEDIVAC), (MARINE,), gap=20.0)
    battle.health[0, 0] = 20
    attack(battle, 0, agent=1)
    loop(battle, 8)
    per_step = 12.6 * 8 / LOOPS_PER_SECOND
    assert battle.health[0, 0] == pytest.approx(20 + per_step)
    assert battle.energy[0, 1] == pytest.approx(50 - per_step / 3 + 0.7875 * 8 / LOOPS_PER_SECOND)
    assert battle.hit[0, 1] == 0
    battle.energy[0, 1] = 0.0
    before = battle.health[0, 0]
    loop(battle)
    assert battle.health[0, 0] == before
    battle.energy[0, 1] = 100.0
    loop(battle, 60)
    assert battle.health[0, 0] == 45
    full = battle.energy[0, 1]
    loop(battle, 8)
    assert battle.energy[0, 1] > full  # nobody to heal


def test_an_enemy_medivac_heals_the_nearest_wounded_friend() -> None:
    battle = duel((MARINE,), (MARINE, MARINE, MEDIVAC), gap=20.0)
    battle.health[0, 1] = 30
    loop(battle, 8)
    assert battle.hit[0, 3] == 1
    assert battle.health[0, 1] > 30


def test_marauders_and_zealots_cannot_hit_a_medivac() -> None:
    battle = duel((MEDIVAC,), (MARAUDER, ZEALOT, MARINE), gap=1.0)
    loop(battle)
    assert battle.target[0, 1:].tolist() == [NOBODY, NOBODY, 0]


def test_an_enemy_attacks_the_nearest_agent_and_keeps_it_while_it_is_in_reach() -> None:
    battle = duel((MARINE, MARINE), (MARINE,), gap=3.0)
    loop(battle)
    assert battle.target[0, 2] == 0
    battle.x[0, 1] = 12.0
    loop(battle)
    assert battle.target[0, 2] == 0
    battle.x[0, 0] = 2.0
    loop(battle)
    assert battle.target[0, 2] == 1


def test_enemies_who_see_nobody_walk_to_where_the_agents_started() -> None:
    battle = duel((MARINE,), (ZEALOT,), gap=15.0)
    battle.x[0, 0] = battle.y[0, 0] = 0.0
    loop(battle, 400)
    assert battle.target[0, 1] == NOBODY
    np.testing.assert_allclose([battle.x[0, 1], battle.y[0, 1]], AGENTS_START, atol=1e-6)


def test_a_unit_out_of_range_moves_towards_its_target_at_its_speed() -> None:
    battle = duel((STALKER,), (MARINE,), gap=12.0)
    attack(battle, 1)
    loop(battle)
    assert (battle.x[0, 0], battle.y[0, 0]) == (pytest.approx(10.0 + 4.13 / LOOPS_PER_SECOND), 10.0)


def test_units_on_the_ground_push_each_other_apart_and_flyers_pass() -> None:
    battle = duel((MARINE, MARINE, MEDIVAC), (MARINE,), gap=20.0)
    battle.y[0, :3] = 10.0, 10.2, 10.1
    for _ in range(10):
        loop(battle)
    assert battle.y[0, 1] - battle.y[0, 0] == pytest.approx(0.75)
    assert battle.y[0, 2] == pytest.approx(10.1)


@pytest.mark.parametrize("battle_map", MAPS, ids=lambda each: each.name)
def test_battles_at_once_equal_single_battles_unit_by_unit(battle_map: SkirmishMap) -> None:
    rng, n_envs = np.random.default_rng(3), 3
    battle = Battle(battle_map, n_envs)
    battle.start(np.arange(n_envs), rng)
    n, n_units = battle.n_agents, battle.n_units
    slow = [SlowBattle(battle_map, battle, env) for env in range(n_envs)]
    for _ in range(25):
        # Orders as the tasks give them: half of the agents go somewhere, the others have a target.
        goals = np.stack([battle.x[:, :n] + 1.5, battle.y[:, :n] + rng.uniform(-1, 1, (n_envs, n))], axis=2)
        targets = np.where(battle.heals[:n], rng.integers(n, size=(n_envs, n)), rng.integers(n, n_units, (n_envs, n)))
        targets[rng.random((n_envs, n)) < 0.4] = NOBODY
        targets[~battle.can_hit[np.arange(n), targets] & ~battle.heals[:n]] = NOBODY
        battle.target[:, :n] = targets
        for env, each in enumerate(slow):
            for unit in each.agents:
                unit.target = int(targets[env, unit.number])
        for _ in range(8):
            battle.loop(goals[..., 0], goals[..., 1])
            for env, each in enumerate(slow):
                each.loop([tuple(goal) for goal in goals[env].tolist()])
        for env, each in enumerate(slow):
            for name in ("x", "y", "health", "shield", "energy", "cooldown"):
                expected = [getattr(unit, name) for unit in each.units]
                np.testing.assert_allclose(getattr(battle, name)[env], expected, atol=1e-7, err_msg=name)
    assert (battle.health == 0).any()
