"""Preferences and trajectories in the files of other programs, and in our own tables.

| module | files | polarity: first better / second better / equal / skip |
|---|---|---|
| `tables` | ours: Parquet tables of segments, queries and labels | 1 / 0 / 0.5 / state "skip" |
| `reference` | the MAPT reference's pickle | 1 / -1 / anything else / none |
| `imitation` | imitation's pickled PreferenceDataset | 1 / 0 / 0.5 / none |
| `offline_labels` | PreferenceTransformer, Clean-Offline-RLHF: pickled indices over D4RL | 0 / 1 / -1 / none |
| `d4rl`, `minari`, `imitation_trajectories` | episodes without labels, to be cut into segments | |

Every reader holds what it finds to be hostile until it is checked: a file that is short, of another shape, of
another polarity or made to run a program ends in a `FileError`, and nothing on disk has changed.
"""
