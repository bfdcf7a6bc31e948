import type { UserAccount } from "@/shared/api/types";
import { Dialog } from "@/shared/ui/Dialog";
import { plural } from "@/shared/ui/format";

interface ConfirmProps {
  user: UserAccount;
  onConfirm: () => void;
  onClose: () => void;
}

export function RevokeUser({ user, onConfirm, onClose }: ConfirmProps) {
  return (
    <Dialog
      title={`Revoke the sign-ins of ${user.name}?`}
      confirm="Revoke"
      danger
      onConfirm={onConfirm}
      onClose={onClose}
    >
      <p>
        Every browser of {user.name} is signed out, and their links and tokens become invalid. A new link lets
        them in again. Labels that their browser has not sent yet are sent after that.
      </p>
    </Dialog>
  );
}

export function RemoveUser({ user, onConfirm, onClose }: ConfirmProps) {
  return (
    <Dialog title={`Remove ${user.name}?`} confirm="Remove" danger onConfirm={onConfirm} onClose={onClose}>
      <p>
        {user.name} can no longer sign in.{" "}
        {user.labels > 0
          ? `Their ${plural(user.labels, "label")} and this name are kept.`
          : "Their experiments, if they started any, are kept under this name."}
      </p>
    </Dialog>
  );
}
