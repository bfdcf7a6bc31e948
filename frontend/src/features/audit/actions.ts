import type { AuditAction } from "@/shared/api/types";

/** What each action is called. */
const TEXTS: Record<AuditAction, string> = {
  signed_in: "Signed in",
  sign_in_failed: "Failed to sign in",
  signed_out: "Signed out",
  joined: "Joined by an invitation",
  user_added: "Added a user",
  user_changed: "Changed a user",
  user_removed: "Removed a user",
  sign_ins_revoked: "Revoked the sign-ins of a user",
  link_created: "Created a sign-in link",
  token_created: "Created a token",
  token_revoked: "Revoked a token",
  invitation_created: "Created an invitation",
  invitation_withdrawn: "Withdrew an invitation",
  experiment_created: "Started an experiment",
  experiment_imported: "Imported an experiment",
  experiment_changed: "Changed an experiment",
  experiment_deleted: "Deleted an experiment",
  experiment_exported: "Exported an experiment",
  experiment_shared: "Created a read-only link",
  share_revoked: "Revoked a read-only link",
  labels_excluded: "Excluded or included labels",
  labeller_changed: "Paused or excluded a labeller",
  gold_changed: "Changed a gold pair",
  webhook_created: "Created a webhook",
  webhook_deleted: "Deleted a webhook",
};

export const ACTIONS = Object.keys(TEXTS) as AuditAction[];

export function actionText(action: AuditAction): string {
  return TEXTS[action];
}

/** The details of an entry on one line; a change is `role: labeller → admin`. */
export function detailText(detail: Readonly<Record<string, unknown>>): string {
  return Object.entries(detail)
    .filter(([, value]) => value !== null)
    .map(([name, value]) => `${name.replaceAll("_", " ")}: ${valueText(value)}`)
    .join(", ");
}

/** Longer lists are counted. */
const MAX_LISTED = 2;

function valueText(value: unknown): string {
  if (Array.isArray(value)) return value.length > MAX_LISTED ? `${value.length} items` : value.join(" → ");
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value === "object" && value !== null) return detailText(value as Record<string, unknown>);
  return String(value);
}
