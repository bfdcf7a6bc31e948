import { useMutation, useQueryClient } from "@tanstack/react-query";
import { useState } from "react";
import { api, unwrap } from "@/shared/api/client";
import { usersQuery } from "@/shared/api/queries";
import type { Access, UserAccount } from "@/shared/api/types";
import type { Secret } from "./SecretDialog";

interface Changes {
  role?: UserAccount["role"];
  access?: Access;
  disabled?: boolean;
}

const byId = (id: string) => ({ params: { path: { user_id: id } } });

/** What an admin can do to a user, the link or token it returned, and why the last action failed. */
export function useUserActions() {
  const cache = useQueryClient();
  const [secret, setSecret] = useState<Secret | null>(null);
  const action = useMutation({
    mutationFn: (run: () => Promise<unknown>) => run(),
    onSettled: () => cache.invalidateQueries({ queryKey: usersQuery.queryKey }),
  });
  const { mutate } = action;
  return {
    error: action.error,
    secret,
    closeSecret: () => setSecret(null),
    change: (id: string, changes: Changes) =>
      mutate(() => unwrap(api.PATCH("/api/v1/users/{user_id}", { ...byId(id), body: changes }))),
    revoke: (id: string) => mutate(() => unwrap(api.POST("/api/v1/users/{user_id}/revoke", byId(id)))),
    remove: (id: string, anonymise: boolean) =>
      mutate(() =>
        unwrap(
          api.DELETE("/api/v1/users/{user_id}", { params: { path: { user_id: id }, query: { anonymise } } }),
        ),
      ),
    createLink: ({ id, name }: UserAccount) =>
      mutate(async () => {
        const link = await unwrap(api.POST("/api/v1/users/{user_id}/link", byId(id)));
        setSecret({ kind: "link", name, text: link.sign_in_url, minutes: link.minutes });
      }),
    createToken: ({ id, name }: UserAccount) =>
      mutate(async () => {
        const { token } = await unwrap(api.POST("/api/v1/users/{user_id}/token", byId(id)));
        setSecret({ kind: "token", name, text: token });
      }),
  };
}
