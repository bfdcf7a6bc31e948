"""Importers and exporters of preferences and trajectories.

| module | files | labels: first preferred / second preferred / equal / skipped |
|---|---|---|
| `tables`, `table_writer` | Accord's Parquet tables of segments, queries and labels | 1 / 0 / 0.5 / state "skip" |
| `reference` | the MAPT reference's pickle | 1 / -1 / anything else / none |
| `imitation` | imitation's pickled PreferenceDataset, and its trajectories | 1 / 0 / 0.5 / none |
| `offline_labels` | PreferenceTransformer, Clean-Offline-RLHF: pickled indices over D4RL | 0 / 1 / -1 / none |
| `d4rl`, `minari` | episodes without labels | |

`reading.read_comparisons` reads the files of other programs by the name of their format, `writing.write_foreign` writes
tables for them. Readers treat files as
untrusted: truncated files, wrong shapes, unknown labels and pickles that would run code raise a `FileError`, and leave
the disk unchanged.
"""
