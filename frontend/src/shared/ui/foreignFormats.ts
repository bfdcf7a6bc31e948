/** Names of the programs whose files are imported and exported, by their formats. */
export const FOREIGN_FORMATS = {
  mapt: "MAPT, reference code",
  imitation: "imitation",
  offline: "Preference Transformer, Clean-Offline-RLHF",
  minari: "Minari",
  d4rl: "D4RL",
} as const;
