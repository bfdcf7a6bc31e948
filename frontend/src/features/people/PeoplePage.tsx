import { useQuery } from "@tanstack/react-query";
import { useState } from "react";
import { errorMessage } from "@/shared/api/errors";
import { usersQuery } from "@/shared/api/queries";
import { canManageUsers, type Me } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { Alert, Message } from "@/shared/ui/Message";
import { AddUser } from "./AddUser";
import { Invitations } from "./Invitations";
import { Invite } from "./Invite";
import { UserTable } from "./UserTable";
import "./people.css";

/** Users and invitations, for admins. */
export function PeoplePage({ me }: { me: Me }) {
  const allowed = canManageUsers(me);
  const users = useQuery({ ...usersQuery, enabled: allowed });
  const [dialog, setDialog] = useState<"add" | "invite" | null>(null);
  if (!allowed) {
    return (
      <Message title="Only admins manage people">
        <p>
          <Link to={paths.experiments()}>All experiments</Link>
        </p>
      </Message>
    );
  }
  const close = () => setDialog(null);
  return (
    <main className="page" id="content">
      <div className="page-head">
        <h1>People</h1>
        <div className="row">
          <button type="button" className="button" onClick={() => setDialog("add")}>
            Add a user
          </button>
          <button type="button" className="button primary" onClick={() => setDialog("invite")}>
            Invite labellers
          </button>
        </div>
      </div>
      {users.error && <Alert>{errorMessage(users.error)}</Alert>}
      {users.data && <UserTable users={users.data} me={me} />}
      <Invitations />
      {dialog === "add" && <AddUser onClose={close} />}
      {dialog === "invite" && <Invite onClose={close} />}
    </main>
  );
}
