import type { components } from "./schema";

type Schemas = components["schemas"];

export type Experiment = Schemas["Experiment"];
export type Label = Schemas["Label"];
export type LabelAuthor = Schemas["LabelAuthor"];
export type LabelCounts = Schemas["LabelCounts"];
export type LabelRevision = Schemas["LabelRevision"];
export type Me = Schemas["Me"];
export type Metrics = Schemas["Metrics"];
export type MetricPoint = Schemas["MetricPoint"];
export type NewExperiment = Schemas["NewExperiment"];
export type NewLabel = Schemas["NewLabel"];
export type OwnLabel = Schemas["OwnLabel"];
export type OwnLabels = Schemas["OwnLabels"];
export type Queries = Schemas["Queries"];
export type Query = Schemas["Query"];
export type RecordedLabel = Schemas["RecordedLabel"];
export type RecordedQuery = Schemas["RecordedQuery"];
export type RewardVersion = Schemas["RewardVersion"];
export type SegmentView = Schemas["SegmentView"];
export type Task = Schemas["TaskSchema"];
export type Worker = Schemas["Worker"];

/** Whether a user may start, pause and cancel experiments. The server enforces this; here it only hides buttons. */
export function canManageExperiments(me: Me): boolean {
  return me.role === "researcher" || me.role === "admin";
}

/** Whether a user may see true returns. The server never sends them to labellers. */
export function canSeeReturns(me: Me): boolean {
  return me.role !== "labeller";
}
