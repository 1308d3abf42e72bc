//! Writes that are answered with metadata alone: who writes an object knows it, and the API server need not encode all of it.

use std::marker::PhantomData;
use std::sync::Arc;

use kube::api::{DeleteParams, Patch, PatchParams, PostParams};
use kube::core::{Request, request};
use kube::{Client, Error, Resource};
use serde::{Deserialize, Serialize};

use super::item::{Item, Watchable};
use super::objects::Meta;

const METADATA_ONLY: &str = "application/json;as=PartialObjectMetadata;g=meta.k8s.io;v=v1";

/// A client that writes as long as this process may.
#[derive(Clone)]
pub struct Writer {
    client: Client,
    may_write: Arc<dyn Fn() -> bool + Send + Sync>,
}

impl Writer {
    /// `may_write` is asked right before each request.
    pub fn new(client: Client, may_write: impl Fn() -> bool + Send + Sync + 'static) -> Self {
        Self {
            client,
            may_write: Arc::new(may_write),
        }
    }
}

/// Writes objects of one kind in one namespace.
pub struct Writes<K> {
    writer: Writer,
    request: Request,
    kind: PhantomData<fn() -> K>,
}

/// Part of an answer that is read. That to a deletion may have none of it.
#[derive(Deserialize, Debug, Default)]
#[serde(default)]
pub struct Written {
    pub metadata: Meta,
}

impl<K: Watchable> Writes<K> {
    pub fn new(writer: &Writer, namespace: &str) -> Self {
        Self {
            writer: writer.clone(),
            request: Request::new(Item::<K>::url_path(&(), Some(namespace))),
            kind: PhantomData,
        }
    }

    pub async fn create(&self, params: &PostParams, object: &impl Serialize) -> kube::Result<Written> {
        let body = serde_json::to_vec(object).map_err(Error::SerdeError)?;
        self.send(self.request.create(params, body)).await
    }

    pub async fn patch<P: Serialize>(
        &self,
        name: &str,
        params: &PatchParams,
        patch: &Patch<P>,
    ) -> kube::Result<Written> {
        self.send(self.request.patch(name, params, patch)).await
    }

    pub async fn patch_status<P: Serialize>(
        &self,
        name: &str,
        params: &PatchParams,
        patch: &Patch<P>,
    ) -> kube::Result<Written> {
        let request = self.request.patch_subresource("status", name, params, patch);
        self.send(request).await
    }

    pub async fn delete(&self, name: &str, params: &DeleteParams) -> kube::Result<Written> {
        self.send(self.request.delete(name, params)).await
    }

    async fn send(&self, request: Result<hyper::Request<Vec<u8>>, request::Error>) -> kube::Result<Written> {
        let mut request = request.map_err(Error::BuildRequest)?;
        if let Ok(accept) = METADATA_ONLY.parse() {
            request.headers_mut().insert("accept", accept);
        }
        if !(self.writer.may_write)() {
            return Err(Error::Service(
                "this process no longer leads, so it writes nothing".into(),
            ));
        }
        self.writer.client.request(request).await
    }
}
