import { useMutation, useQueryClient } from "@tanstack/react-query";
import { api, unwrap } from "@/shared/api/client";
import { meQuery } from "@/shared/api/queries";
import type { Me } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";

/** The name and role of the signed-in user, the link to their tokens, and the sign-out button. */
export function UserMenu({ me }: { me: Me }) {
  const cache = useQueryClient();
  const signOut = useMutation({
    mutationFn: () => unwrap(api.POST("/api/v1/sign-out")),
    // The cache keeps the user, as when the session ends otherwise: the sign-in page shows who was signed in.
    onSuccess: () => cache.invalidateQueries({ queryKey: meQuery.queryKey }),
  });
  return (
    <div className="user">
      <span className="user-name" title={`Signed in as ${me.name}, ${me.role}`}>
        {me.name} {me.name !== me.role && <span className="muted">{me.role}</span>}
      </span>
      <Link to={paths.account()} className="user-tokens">
        Tokens
      </Link>
      <button
        type="button"
        className="button small"
        disabled={signOut.isPending}
        onClick={() => signOut.mutate()}
      >
        Sign out
      </button>
    </div>
  );
}
