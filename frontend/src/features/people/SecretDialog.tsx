import { CopyLine } from "@/shared/ui/CopyLine";
import { Dialog } from "@/shared/ui/Dialog";
import { formatDuration } from "@/shared/ui/format";

/** A link or token that the server shows once. */
export type Secret =
  | { kind: "link"; name: string; text: string; minutes: number }
  | { kind: "token"; name: string; text: string }
  | { kind: "invitation"; text: string; uses: number };

export function SecretDialog({ secret, onClose }: { secret: Secret; onClose: () => void }) {
  return (
    <Dialog
      title={titleOf(secret)}
      confirm="Done"
      cancel={null}
      onConfirm={() => undefined}
      onClose={onClose}
    >
      <CopyLine text={secret.text} />
      <p>{explanationOf(secret)}</p>
    </Dialog>
  );
}

function titleOf(secret: Secret): string {
  if (secret.kind === "link") return `Sign-in link for ${secret.name}`;
  return secret.kind === "token" ? `Token for ${secret.name}` : "Invitation";
}

function explanationOf(secret: Secret): string {
  switch (secret.kind) {
    case "link":
      return `Send it to nobody else: it signs in whoever opens it first. It works once, within ${formatDuration(60 * secret.minutes)}, and is not shown again.`;
    case "token":
      return "A program sends it with every request. It is not shown again.";
    case "invitation":
      return `${secret.uses === 1 ? "One person" : `${secret.uses} people`} can join by it. It is not shown again, but you can withdraw it.`;
  }
}
