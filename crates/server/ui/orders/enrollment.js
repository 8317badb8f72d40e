// The enrollment of a robot: a new token, and the command that uses it.

import { post } from '../api/api.js';

/** Creates an enrollment token. */
export const createEnrollmentToken = (request = {}) => post('/enrollment-tokens', request);

/** The command that enrolls a robot. */
export const enrollCommand = ({ token }) =>
  `task-agent enroll --server ${location.origin} --token ${token}`;
