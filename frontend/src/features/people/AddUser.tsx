import { useMutation, useQueryClient } from "@tanstack/react-query";
import { useId, useState } from "react";
import { api, unwrap } from "@/shared/api/client";
import { errorMessage } from "@/shared/api/errors";
import { usersQuery } from "@/shared/api/queries";
import type { Access, UserAccount } from "@/shared/api/types";
import { CopyLine } from "@/shared/ui/CopyLine";
import { Dialog } from "@/shared/ui/Dialog";
import { Alert } from "@/shared/ui/Message";
import { AccessChoice } from "./AccessChoice";
import { canBeLimited, ROLES } from "./roles";

/** A dialog that adds a user and then shows their sign-in link, and the token of a program. */
export function AddUser({ onClose }: { onClose: () => void }) {
  const id = useId();
  const cache = useQueryClient();
  const [name, setName] = useState("");
  const [role, setRole] = useState<UserAccount["role"]>("labeller");
  const [access, setAccess] = useState<Access>({ all_experiments: true, experiment_ids: [] });
  const add = useMutation({
    mutationFn: () => unwrap(api.POST("/api/v1/users", { body: { name, role, access } })),
    onSuccess: () => cache.invalidateQueries({ queryKey: usersQuery.queryKey }),
  });
  if (add.data) {
    return (
      <Dialog
        key="added"
        title={`${add.data.name} was added`}
        confirm="Done"
        cancel={null}
        onConfirm={() => undefined}
        onClose={onClose}
      >
        <p>{role === "teacher" ? "The program’s token:" : "Their sign-in link, which works once:"}</p>
        <CopyLine text={role === "teacher" ? add.data.token : add.data.sign_in_url} />
        <p className="muted">It is not shown again. You can create another one at any time.</p>
      </Dialog>
    );
  }
  return (
    <Dialog
      key="form"
      title="Add a user"
      confirm="Add"
      enabled={name.trim() !== "" && !add.isPending}
      staysOpen
      onConfirm={() => add.mutate()}
      onClose={onClose}
    >
      <label htmlFor={`${id}-name`}>Name</label>
      <input
        id={`${id}-name`}
        value={name}
        maxLength={100}
        onChange={(event) => setName(event.target.value)}
      />
      <label htmlFor={`${id}-role`}>Role</label>
      <select
        id={`${id}-role`}
        value={role}
        onChange={(event) => setRole(event.target.value as UserAccount["role"])}
      >
        {ROLES.map(([each, text]) => (
          <option key={each} value={each}>
            {text}
          </option>
        ))}
      </select>
      {canBeLimited(role) && <AccessChoice access={access} onChange={setAccess} />}
      {add.error && <Alert>{errorMessage(add.error)}</Alert>}
    </Dialog>
  );
}
