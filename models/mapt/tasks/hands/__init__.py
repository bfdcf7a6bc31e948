"""Two Shadow hands that catch and open doors: Bi-DexHands' tasks in MuJoCo, one agent per hand."""
