import { useState } from "react";
import type { Access, UserAccount } from "@/shared/api/types";
import { Dialog } from "@/shared/ui/Dialog";
import { AccessChoice } from "./AccessChoice";

interface AccessDialogProps {
  user: UserAccount;
  onSave: (access: Access) => void;
  onClose: () => void;
}

/** A dialog that changes which experiments a user sees. */
export function AccessDialog({ user, onSave, onClose }: AccessDialogProps) {
  const [access, setAccess] = useState(user.access);
  return (
    <Dialog
      title={`Experiments of ${user.name}`}
      confirm="Save"
      onConfirm={() => onSave(access)}
      onClose={onClose}
    >
      <AccessChoice access={access} onChange={setAccess} />
    </Dialog>
  );
}
